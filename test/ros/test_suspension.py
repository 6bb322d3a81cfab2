"""The node suspension, with the car that the bridge emulates and the controller of its damper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mr_damper_msgs.msg import CurrentCommand, DesiredForce, SupplyCurrent
from sensor_msgs.msg import JointState
from support import Listener

from mr_damper_ros.emulation.plant_rig import invented_damper
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import header

OWN = """
def floor(now):
    if now.body < 0.0:
        raise RuntimeError("not like this")
    return 1234.0 * now.apart
"""


def test_the_car_is_commanded(start: Any, listener: Listener, tmp_path: Path) -> None:
    known = tmp_path / "known.yaml"
    invented_damper(0.01).save(known)
    motions = listener.listen(JointState, "suspension/motion")
    forces = listener.listen(DesiredForce, "damper/desired_force")
    commands = listener.listen(CurrentCommand, "supply/current_command")
    currents = listener.listen(SupplyCurrent, "supply/current")
    start("suspension", damping=2000.0)
    start("controller", parameter_file=known, maximum_error=0.0, max_age=0.0, demand_timeout=1.0)
    for topic in ("supply/current_command", "damper/desired_force"):
        listener.wait_for_publishers(topic)
    # Slow enough for a busy computer.
    start(
        "bridge",
        source="quarter_car",
        quarter_car__sample_rate=500.0,
        rate=0.3,
        wait_for_subscribers=2,
    )
    listener.until(
        lambda: (
            any(command.current > 0.05 for command in commands)
            and any(current.current > 0.05 for current in currents)
        ),
        "a current that the skyhook wants",
    )
    motion = {(m.header.stamp.sec, m.header.stamp.nanosec): m for m in motions}
    pairs = [(motion.get((f.header.stamp.sec, f.header.stamp.nanosec)), f) for f in forces]
    known_pairs = [(m, f) for m, f in pairs if m is not None]
    assert len(known_pairs) > 20
    assert all(f.force == 2000.0 * m.velocity[0] for m, f in known_pairs)


def test_ones_own_controller_is_one_function(
    start: Any, listener: Listener, tmp_path: Path, monkeypatch: Any
) -> None:
    (tmp_path / "mine.py").write_text(OWN, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    forces = listener.listen(DesiredForce, "damper/desired_force")
    node = start("suspension", function="mine:floor", frame_id="left", largest_force=100.0)
    listener.wait_for_publishers("damper/desired_force")
    moved = listener.node.create_publisher(JointState, "suspension/motion", quality.stream())

    def move(body: float, extension: float) -> None:
        moved.publish(
            JointState(
                header=header(5, "car"),
                name=["body", "wheel", "suspension"],
                position=[0.0, 0.0, extension],
                velocity=[body, 0.0, 0.0],
            )
        )

    listener.until(lambda: moved.get_subscription_count() > 0, "the node's subscription")

    def answered() -> bool:
        """Whether a force has come; the first ones are for nobody, as long as nobody is known."""
        move(0.1, 0.01)
        return bool(forces)

    listener.until(answered, "a force")
    move(-0.1, 0.01)
    node.wait_for_log("not like this")
    move(0.1, 1.0)
    listener.until(lambda: forces[-1].force == 100.0, "the force after the failure")
    assert {force.force for force in forces} == {12.34, 100.0}
    assert forces[0].header.frame_id == "left"


def test_a_function_that_is_not_there_is_one_sentence(start: Any) -> None:
    node = start("suspension", function="nowhere_at_all:f")
    assert node.wait() == 2
    assert "PYTHONPATH" in node.log
