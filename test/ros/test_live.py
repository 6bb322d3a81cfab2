"""The page of a running system receives the nodes' data and commands the identifier."""

import errno
import http.client
import json
import os
import re
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import DamperSignals, FitReport, PredictedForce
from rclpy.node import Node
from sensor_msgs.msg import Temperature
from support import PATIENCE, Listener, TriedProgram, assert_one_sentence

from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import BagStream
from mr_damper_ros.live.live_record import SIGNALS
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.live_node import LiveNode
from mr_damper_ros.nodes.messages import from_field, to_nanoseconds
from mr_damper_ros.processes.programs import node_arguments
from mr_damper_ros.signals.blocks import SILENCE
from mr_damper_ros.tools.live import empty_record, replay_into

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"


class Client:
    """Sends requests to a page like a browser."""

    def __init__(self, program: TriedProgram) -> None:
        program.wait_for_log("the page is at http://")
        found = re.search(r"the page is at (http://\S+)", program.log)
        assert found
        self.netloc = urlsplit(found[1]).netloc

    def get(self, path: str, host: str = "") -> tuple[dict[str, str], bytes]:
        connection = http.client.HTTPConnection(self.netloc, timeout=PATIENCE)
        try:
            connection.request("GET", path, headers={"Host": host} if host else {})
            answer = connection.getresponse()
            return dict(answer.headers), answer.read()
        finally:
            connection.close()

    def status(self) -> dict[str, Any]:
        return json.loads(self.get("/status")[1])

    def signals(self) -> dict[str, np.ndarray]:
        rows = np.frombuffer(self.get("/tables/signals")[1]).reshape(-1, len(SIGNALS) + 1)
        return dict(zip(("index", *SIGNALS), rows.T, strict=True))

    def command(self, command: str, **told: str) -> int:
        connection = http.client.HTTPConnection(self.netloc, timeout=PATIENCE)
        try:
            origin = {"Origin": f"http://{self.netloc}"}
            connection.request("POST", f"/command?{urlencode(told)}", command, origin)
            return connection.getresponse().status
        finally:
            connection.close()


@pytest.fixture
def client(start: Any, listener: Listener) -> Client:
    """The page of an identifier and a model that wait for samples."""
    start("identifier")
    start("model")
    client = Client(start("live", port=0, allow_commands=True))
    listener.until(lambda: client.status()["set"], "the set that the identifier starts with")
    return client


def test_the_page_has_what_the_nodes_say(client: Client, start: Any, listener: Listener) -> None:
    forces: list[PredictedForce] = listener.listen(
        PredictedForce, "damper/predicted_force", quality.lossless()
    )
    signals: list[DamperSignals] = listener.listen(
        DamperSignals, "damper/signals", quality.lossless()
    )
    numbers: list[DiagnosticArray] = listener.listen(
        DiagnosticArray, "damper/identified", quality.lossless()
    )
    for topic in ("predicted_force", "signals", "identified"):
        listener.wait_for_publishers(f"damper/{topic}")
    replay = start("replay", bag=BAG, rate=2.0, wait_for_subscribers=2)
    listener.until(lambda: not replay.running, "the end of the bag")
    listener.until(lambda: sum(w["accepted"] for w in client.status()["windows"]), "a new set")
    listener.until(lambda: client.status()["tables"]["signals"]["next"] > 500, "the signals")
    listener.until(lambda: {"coefficients", "parameters"} <= kinds_of(numbers), "named numbers")

    assert_named_numbers_are_those_of_one_sample(signals, forces)
    assert_coefficients_and_parameters_are_named(numbers)
    told, shown = client.status(), client.signals()
    assert np.all(np.diff(shown["time"]) > 0.0)
    measured = shown["measured_force"]
    valid = shown["valid"] == 1.0
    assert valid.any()
    error = shown["force_error"][valid]
    assert np.std(error) < 0.2 * np.std(measured)
    assert told["set"]["model"] == "sigmoid"
    assert {"windows", "coefficients", "parameters"} <= set(told["tables"])
    assert {"model: prediction", "identifier: fit"} <= {c["name"] for c in told["concerns"]}


def assert_named_numbers_are_those_of_one_sample(
    signals: list[DamperSignals], forces: list[PredictedForce]
) -> None:
    stamps = np.array([to_nanoseconds(message.header.stamp) for message in signals])
    steps = np.diff(stamps)
    assert np.all(np.abs(steps - 10_000_000) <= 1_000_000), "100 Hz, to one sample"
    predicted = {}
    for message in forces:
        begin = to_nanoseconds(message.header.stamp)
        for k, force in enumerate(from_field(message.force)):
            valid = message.sample_doubts[k] == PredictedForce.NONE
            predicted[begin + round(k * message.period * 1e9)] = (force, valid)
    found = [(m, predicted[s]) for m, s in zip(signals, stamps, strict=True) if s in predicted]
    assert len(found) > 0.9 * len(signals)
    for message, (force, valid) in found:
        assert message.valid == valid
        np.testing.assert_equal(message.predicted_force, force)
        np.testing.assert_equal(message.force_error, force - message.measured_force)


def kinds_of(numbers: list[DiagnosticArray]) -> set[str]:
    return {status.name for array in numbers for status in array.status}


def assert_coefficients_and_parameters_are_named(numbers: list[DiagnosticArray]) -> None:
    kinds = {status.name: status for array in numbers for status in array.status}
    assert set(kinds) == {"coefficients", "parameters"}
    named = {entry.key: float(entry.value) for entry in kinds["coefficients"].values}
    assert named["f_t"] > 0.0
    assert named["f_t_error"] > 0.0
    assert "f0" in {entry.key for entry in kinds["parameters"].values}


def test_numbers_out_of_range_do_not_end_the_page(client: Client, listener: Listener) -> None:
    temperature = listener.node.create_publisher(Temperature, "damper/fluid_temperature", 1)
    report = listener.node.create_publisher(FitReport, "damper/fit_report", 1)
    for publisher in (temperature, report):
        listener.until(publisher.get_subscription_count, publisher.topic_name)
    temperature.publish(Temperature(temperature=30.0, variance=-1.0))
    report.publish(FitReport(verdict=99))
    listener.until(lambda: client.status()["windows"], "the report")
    assert client.status()["windows"][0]["verdict"] == "UNKNOWN"


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_recordings_end_alone_with_their_messages_and_their_failures(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    writers: list[Any] = []
    create = Node.create_subscription

    def recorded(node: Node, *told: Any, raw: bool = False, **more: Any) -> Any:
        writers.extend(told[2:3] * raw)
        return create(node, *told, raw=raw, **more)

    monkeypatch.setattr(Node, "create_subscription", recorded)
    options = node_arguments({"port": 0, "allow_commands": True, "record_folder": tmp_path})
    rclpy.init(args=options)
    try:
        node = LiveNode()
        for name in ("one", "two"):
            node._take_command("record", {"name": name})
            node.do_commands()
            assert node._record.status(0)["recording"]["name"] == name
            node._take_command("stop_recording", {})
            node.do_commands()
            writers[0](b"late")
        monkeypatch.setattr(BagStream, "write", full)
        node._take_command("record", {"name": "three"})
        node.do_commands()
        writers[-1](b"more")
        node.do_commands()
        told = node._record.status(0)["events"][-1]
        assert "failed: No space left on device: free space there" in told
        assert f"; what was written is in {tmp_path}/" in told
        node.destroy_node()
    finally:
        rclpy.shutdown()
    assert len(list(tmp_path.iterdir())) == 3


def test_a_command_reaches_the_identifier(client: Client, listener: Listener) -> None:
    def done() -> bool:
        """Whether the identifier has answered; the page may not have discovered it yet."""
        client.command("reset")
        events = client.status()["events"]
        return any(event.startswith("reset: done: running with") for event in events)

    listener.until(done, "the identifier's answer", tick=0.5)


def test_a_command_that_nobody_takes_is_told(start: Any, listener: Listener) -> None:
    client = Client(start("live", port=0, allow_commands=True))
    assert client.command("reset") == 202
    listener.until(lambda: client.status()["events"], "what came of it")
    assert "no node offers" in client.status()["events"][0]


def test_it_only_shows_unless_commands_are_allowed_and_has_its_port_alone(start: Any) -> None:
    client = Client(start("live", port=0))
    assert client.command("reset") == 403
    assert client.status()["commands"] == []
    port = int(client.netloc.rpartition(":")[2])
    second = start("live", port=port)
    assert second.wait() == 2
    assert_one_sentence(second.errors)
    assert f"port {port}" in second.errors


def test_a_killed_node_is_told_from_one_without_samples(start: Any, listener: Listener) -> None:
    left = {"__ns": "/left"}
    start("identifier", remap=left)
    model = start("model", remap=left)
    client = Client(start("live", remap=left, port=0))

    def silences(node: str) -> list[float]:
        return [c["silence"] for c in client.status()["concerns"] if c["name"].startswith(node)]

    listener.until(lambda: silences("model:") and silences("identifier:"), "all diagnostics")
    model.kill()
    listener.until(lambda: min(silences("model:")) > SILENCE, "the model's silence")
    listener.until(lambda: max(silences("identifier:")) < SILENCE, "the identifier's news")


def test_other_hosts_are_allowed_by_a_parameter(start: Any) -> None:
    client = Client(start("live", port=0, allowed_hosts="proxy.example rig.example"))
    assert json.loads(client.get("/status", host="rig.example")[1])


def test_a_run_is_recorded_and_opened_again(start: Any, listener: Listener, tmp_path: Path) -> None:
    start("identifier")
    start("model")
    live = Client(start("live", port=0, allow_commands=True, record_folder=str(tmp_path)))
    listener.until(lambda: live.status()["set"], "the set that the identifier starts with")
    told = {"name": "first run", "operator": "Ada", "note": "cold"}
    assert live.command("record", **told) == 202
    listener.until(lambda: live.status()["recording"], "the beginning of the recording")
    replay = start("replay", bag=BAG, rate=2.0, wait_for_subscribers=3)
    listener.until(lambda: not replay.running, "the end of the bag")
    listener.until(lambda: live.status()["tables"]["signals"]["next"] > 500, "the signals")
    assert live.status()["tables"]["samples"]["next"] > 4000, "the full rate"
    listener.until(lambda: live.status()["silence"] > SILENCE, "the silence")
    assert "the recording has ended" in [each["message"] for each in live.status()["concerns"]]
    assert live.status()["faults"] == []
    live.command("stop_recording")
    listener.until(lambda: "recorded: " in " ".join(live.status()["events"]), "the bag")

    (bag,) = tmp_path.iterdir()
    (recorded,), (original,) = read_bag(bag), read_bag(BAG)
    np.testing.assert_array_equal(recorded.force, original.force)
    record = empty_record(bag)
    replay_into(record, bag)
    again = record.status(0)
    assert sum(window["accepted"] for window in again["windows"]) > 0
    assert again["recorded"] == f"first run, Ada, cold, {bag.name}"
    assert recorded.details["start_set"]
