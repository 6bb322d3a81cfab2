"""Managed nodes: how one configures, activates, stops, and lets its device go."""

from __future__ import annotations

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from mr_damper_ros.nodes import rclpy_internals
from mr_damper_ros.nodes.node_parameters import ConfigurationError


class ManagedNode(LifecycleNode):
    """A lifecycle node, which refuses what its state does not allow.

    A node says how it configures and activates, how it stops (:meth:`_stop`) and how it lets its
    device go (:meth:`_close`).
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._problem = ""
        self._starting = False
        rclpy_internals.refuse_wrong_transitions(self)

    def _start_by_itself(self) -> None:
        """Configure and activate; raises ConfigurationError with the problem."""
        self._starting = True
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                raise ConfigurationError(self._problem)
        self._starting = False

    def _fail(self, what: str, error: object) -> TransitionCallbackReturn:
        """Note the problem, and tell it unless the start does."""
        self._problem = f"{what}: {error}"
        if not self._starting:
            self.get_logger().error(self._problem)
        return TransitionCallbackReturn.FAILURE

    def _stop(self) -> None:
        """Undo the activation, if there was one."""
        raise NotImplementedError

    def _close(self) -> None:
        """Undo the configuration, if there was one."""
        raise NotImplementedError

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop; rclpy calls it, as the two below."""
        self._stop()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the device go."""
        self._close()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good."""
        self._stop()
        self._close()
        return TransitionCallbackReturn.SUCCESS
