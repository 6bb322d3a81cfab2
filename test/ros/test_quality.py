"""Quality of service: late joiners, best effort on either side, overrides."""

from pathlib import Path
from typing import Any

from mr_damper_msgs.msg import MtsSamples, PredictedForce
from press import block_message
from rclpy.qos import QoSProfile, ReliabilityPolicy
from support import Listener

from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.nodes import quality

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"


def best_effort() -> QoSProfile:
    return QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, depth=10)


def test_a_best_effort_publisher_is_told_and_can_be_taken(start: Any, listener: Listener) -> None:
    samples = listener.node.create_publisher(MtsSamples, "mts/samples", best_effort())
    start("model")
    listener.wait_for_finding("model: input", "is published best effort")
    forces = listener.listen(PredictedForce, "damper/predicted_force", quality.lossless())
    start(
        "model",
        "--ros-args",
        *("-r", "__node:=other"),
        *("-p", "qos_overrides./mts/samples.subscription.reliability:=best_effort"),
    )
    message = block_message(read_bag(BAG)[0], 0)

    def answered() -> bool:
        samples.publish(message)
        return bool(forces)

    listener.until(answered, "a prediction for what a best effort publisher sends")


def test_an_override_for_another_topic_is_told(start: Any) -> None:
    name = "qos_overrides./misspelt.subscription.depth"
    model = start("model", "--ros-args", "-p", f"{name}:=10")
    model.wait_for_log(f"{name} is not used")


def test_two_nodes_that_publish_the_samples_are_named(start: Any, listener: Listener) -> None:
    samples = listener.node.create_publisher(MtsSamples, "mts/samples", quality.stream())
    start("bridge")
    start("model")
    message = block_message(read_bag(BAG)[0], 0)
    listener.node.create_timer(0.1, lambda: samples.publish(message))
    part = "mts/samples is published by /bridge and /listener: stop all but one; "
    listener.wait_for_finding("model: input", part)
