"""Managed nodes, started by themselves or by a manager; a wrong request does not end them."""

from __future__ import annotations

from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from mr_damper_ros.nodes.node_parameters import ConfigurationError


class ManagedNode(LifecycleNode):
    """A lifecycle node that refuses what its state does not allow.

    rclpy raises out of the executor there, and the node would be gone: a manager may well ask a
    node to deactivate that has just lost its device and is inactive.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._problem = ""
        self._starting = False
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._change_state_if_allowed

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

    def _change_state_if_allowed(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        try:
            changed: ChangeState.Response = self._change_state(request, response)
        except rclpy_implementation.RCLError:
            state = self._state_machine.current_state[1]
            asked = request.transition.label or f"number {request.transition.id}"
            self.get_logger().warning(f"no transition {asked} from the state {state}: it stays so")
            response.success = False
            return response
        return changed
