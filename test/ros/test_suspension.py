"""The suspension node with the emulated car of the bridge and the damper's controller."""

from pathlib import Path
from typing import Any

import numpy as np
from mr_damper_msgs.msg import DesiredForce, FitReport, PredictedForce, SupplyCurrent
from sensor_msgs.msg import JointState
from support import Listener

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import header

MEAN_CURRENT = 0.15
"""Mean supply current [A] of a loop that controls; 0.37 to 0.42 A in longer drives."""

OWN = """
def floor(now):
    if now.body < 0.0:
        raise RuntimeError("not like this")
    return 1234.0 * now.stroke
"""


def test_the_documented_loop_controls_a_car_while_its_damper_is_identified(
    start: Any, listener: Listener
) -> None:
    known = Path(__file__).parents[2] / "config" / "invented_damper.yaml"
    motions = listener.listen(JointState, "suspension/motion")
    forces = listener.listen(DesiredForce, "damper/desired_force")
    currents = listener.listen(SupplyCurrent, "supply/current")
    predictions = listener.listen(PredictedForce, "damper/predicted_force")
    reports = listener.listen(FitReport, "damper/fit_report")
    # A busy computer slows the car down, so its blocks may be late by the wall clock.
    start("controller", parameter_file=known, highest_current=1.6, max_age=0.0, demand_timeout=1.0)
    start("identifier", initial_parameters=known)
    start("model", parameter_file=known, max_age=0.0)
    start("suspension", controller="hybrid", damping=25e3, share=0.7)
    for topic in ("supply/current_command", "damper/desired_force", "damper/predicted_force"):
        listener.wait_for_publishers(topic)
    start("bridge", source="quarter_car", quarter_car__road="C", rate=0.6, wait_for_subscribers=4)
    listener.until(
        lambda: sum(len(p.force) * p.period for p in predictions) > 7.0, "a drive", patience=120.0
    )
    # Seconds of driving after which motion and peak velocity are known.
    late = [p for p in predictions if seconds(p) > seconds(predictions[0]) + 5.0]
    valid = np.concatenate([p.sample_doubts for p in late]) == PredictedForce.NONE
    assert np.mean(valid) > 0.9
    driven = [each.current for each in currents if seconds(each) > seconds(late[0])]
    assert np.mean(driven) > MEAN_CURRENT
    assert any(report.confirms for report in reports)
    motion = {seconds(m): m for m in motions}
    pairs = [(motion[seconds(f)], f) for f in forces if seconds(f) in motion]
    assert len(pairs) > 20
    hybrid = [25e3 * (0.7 * m.velocity[0] - 0.3 * m.velocity[1]) for m, _ in pairs]
    np.testing.assert_allclose([f.force for _, f in pairs], hybrid, rtol=1e-9)


def seconds(message: Any) -> float:
    stamp = message.header.stamp
    return stamp.sec + 1e-9 * stamp.nanosec


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
        """Whether a force has been received; the first ones are lost until the nodes connect."""
        move(0.1, 0.01)
        return bool(forces)

    listener.until(answered, "a force")
    move(-0.1, 0.01)
    node.wait_for_log("not like this")
    listener.wait_for_finding("suspension: force", "could not be used: the controller failed")
    move(0.1, 1.0)
    listener.until(lambda: forces[-1].force == 100.0, "the force after the failure")
    assert {force.force for force in forces} == {12.34, 100.0}
    assert forces[0].header.frame_id == "left"
