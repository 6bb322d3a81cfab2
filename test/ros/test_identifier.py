"""The identifier as a process: its topics, its stored state, and its robustness."""

import math
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from mr_damper_msgs.action import IdentifyGlobal
from mr_damper_msgs.msg import DamperParameters, FitReport
from mr_damper_msgs.srv import LoadParameters, SaveParameters
from press import BAD_BLOCKS, Press, block_message
from rclpy.action import ActionClient
from std_srvs.srv import Trigger
from support import Listener, assert_one_sentence
from waiting import is_gone, until

import mr_damper_ros as mr
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.models.domain import Origin
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import parameter_set, parameters_message, report_message
from mr_damper_ros.signals.recording import Recording

ROOT = Path(__file__).parents[2]
BAG = ROOT / "bags" / "5.0mm_1Hz_1.5A"
WINDOWS = 6
"""Windows of 2 s, one every second, in the 7 s of a bag."""


class Results:
    """Messages of an identifier from the first one on."""

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self.reports: list[FitReport] = listener.listen(FitReport, "damper/fit_report")
        self.sets: list[DamperParameters] = listener.listen(
            DamperParameters, "damper/parameters", quality.latched()
        )

    def wait_for_the_start(self) -> DamperParameters:
        """Wait until no message can be missed; returns the initial set."""
        subscriptions = list(self._listener.node.subscriptions)
        self._listener.until(
            lambda: (
                self.sets
                and all(
                    subscription.get_publisher_count()
                    for subscription in subscriptions
                    if subscription.topic_name.startswith("/damper/")
                )
            ),
            "the initial set",
        )
        return self.sets[0]

    def wait_for_reports(self, count: int) -> None:
        self._listener.until(lambda: len(self.reports) >= count, f"fit report number {count}")

    @property
    def accepted(self) -> list[str]:
        return [report.parameter_set for report in self.reports if report.accepted]


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_bag(BAG)[0]


@pytest.fixture
def results(listener: Listener) -> Results:
    return Results(listener)


def worker_pid(listener: Listener) -> int:
    status = listener.wait_for_finding("identifier: worker", "idle")
    return int(next(item.value for item in status.values if item.key == "process"))


def comparable(messages: list[Any]) -> list[str]:
    """Everything but the measured computing time."""
    for message in messages:
        if isinstance(message, FitReport):
            message.duration = 0.0
    return [str(message) for message in messages]


def test_a_bag_gives_the_same_sets_at_every_rate(start: Any, listener: Listener) -> None:
    outcomes = []
    for rate in (0.0, 4.0):
        with Listener() as own:
            results = Results(own)
            identifier = start("identifier")
            initial = results.wait_for_the_start()
            assert initial.id == "literature"
            assert list(initial.values) == list(LITERATURE)
            replay = start("replay", bag=BAG, rate=rate)
            results.wait_for_reports(WINDOWS)
            own.until(lambda: len(results.sets) > len(results.accepted), "all sets")  # noqa: B023
            assert replay.wait() == 0
            identifier.stop()
            outcomes.append(comparable(results.reports) + comparable(results.sets))
    assert outcomes[0] == outcomes[1]
    replayed = mr.replay(BAG)
    reports = [report_message(report, 0.0, "damper", "/identifier") for report in replayed.reports]
    for message in reports:
        message.verdict = int(message.verdict)  # as received
    sets = [parameters_message(found, "damper", "/identifier") for found in replayed.sets]
    before, (initial, *published) = outcomes[0][:WINDOWS], outcomes[0][WINDOWS:]
    assert before == comparable(reports)
    assert published == comparable(sets)


def test_every_window_has_its_report_and_the_sets_fit(
    start: Any, listener: Listener, results: Results, recording: Recording
) -> None:
    start("identifier")
    results.wait_for_the_start()
    Press(listener).run(recording)
    results.wait_for_reports(WINDOWS)
    listener.until(lambda: len(results.sets) > len(results.accepted), "all sets")

    starts = [r.window_start.sec * 10**9 + r.window_start.nanosec for r in results.reports]
    assert starts == [recording.start_ns + k * 10**9 for k in range(WINDOWS)]
    spread = float(np.std(recording.force))
    for report in results.reports:
        assert report.header.frame_id == "damper"
        assert report.samples == 2000
        assert report.window_duration == pytest.approx(1.999)
        assert report.method == "nelder_mead"
        assert report.evaluations > 0
        assert report.duration > 0.0
        assert report.reason
        assert report.nrmse_after == pytest.approx(5.53 / spread, rel=0.15)
        assert not report.accepted or report.nrmse_after < report.nrmse_before
        assert report.verdict == (FitReport.ACCEPTED if report.accepted else FitReport.NO_BETTER)
        assert report.confirms
        assert report.amplitude == pytest.approx(5e-3, rel=0.01)
        assert report.frequency == pytest.approx(1.0, rel=0.01)
        assert report.peak_velocity == pytest.approx(2.0 * math.pi * 5e-3, rel=0.01)
        assert report.current == 1.5
        assert math.isnan(report.temperature)
        assert len(report.coefficients) == len(report.coefficient_names) == 7
    assert results.reports[0].accepted
    assert results.reports[0].nrmse_before > 1.0
    assert [message.id for message in results.sets] == ["literature", *results.accepted]
    assert {message.node for message in results.sets} == {"/identifier"}
    last = parameter_set(results.sets[-1])
    assert last.current_range == (1.5, 1.5)
    assert last.observable.any()
    assert not last.observable.all()
    assert (np.isnan(last.standard_errors) == ~last.observable).all()
    listener.wait_for_finding("identifier: input", "samples")
    listener.wait_for_finding("identifier: parameters", f"running with {last.set_id}")


def test_it_says_what_is_missing(start: Any, listener: Listener, recording: Recording) -> None:
    start("identifier")
    listener.wait_for_finding("identifier: input", "nothing publishes mts/samples")
    listener.wait_for_finding("identifier: current", "nothing publishes supply/current")
    listener.wait_for_finding("identifier: parameters", "no window accepted yet")
    listener.wait_for_finding("identifier: state", "state_dir is not set")
    press = Press(listener)
    listener.wait_for_finding("identifier: input", "nothing arrives on mts/samples")
    press.run(recording, with_current=False)
    listener.wait_for_finding("identifier: window", "waits for a supply current")


def test_blocks_that_cannot_be_used_are_counted_and_change_nothing(
    start: Any, listener: Listener, results: Results, recording: Recording
) -> None:
    start("identifier")
    results.wait_for_the_start()
    press = Press(listener)
    for sentence, changes in BAD_BLOCKS.items():
        press.samples.publish(block_message(recording, 0, **changes))
        listener.wait_for_finding("identifier: input", sentence)
    press.send_current(recording.start_ns, math.nan)
    listener.wait_for_finding("identifier: current", "the current is nan")
    assert [message.id for message in results.sets] == ["literature"]
    press.run(recording)
    results.wait_for_reports(WINDOWS)
    assert results.accepted
    # A whole window is invalid: its displacement is in millimetres.
    later = replace(
        recording, start_ns=recording.start_ns + 10**10, displacement=1e3 * recording.displacement
    )
    press.run(later)
    results.wait_for_reports(2 * WINDOWS)
    for report in results.reports[WINDOWS:]:
        assert report.verdict == FitReport.FAULT_OF_DATA
        assert not report.accepted
        assert not report.confirms
        assert "millimetres" in report.reason
    assert results.sets[-1].id == results.accepted[-1]
    listener.wait_for_finding("identifier: fit", "millimetres")


def test_sets_are_saved_loaded_reset_and_survive_a_restart(
    start: Any, listener: Listener, results: Results, recording: Recording, tmp_path: Path
) -> None:
    def call(service_type: Any, service: str, **fields: str) -> Any:
        request = service_type.Request(**fields)
        return listener.call(service_type, f"identifier/{service}", request)

    def now_running(set_id: str) -> None:
        listener.until(lambda: results.sets[-1].id == set_id, f"the set {set_id}")

    identifier = start("identifier", state_dir=tmp_path)
    results.wait_for_the_start()
    press = Press(listener)
    press.run(recording)
    results.wait_for_reports(WINDOWS)
    last = results.accepted[-1]
    now_running(last)
    identified = results.sets[-1]
    saved = call(SaveParameters, "save_parameters", name="warm")
    assert saved.success
    assert str(tmp_path / "warm.yaml") in saved.message
    assert list(ParameterSet.from_yaml((tmp_path / "warm.yaml").read_text()).values) == list(
        identified.values
    )
    for name in ("../warm", "/etc/passwd", "a/b", ".."):
        refused = call(SaveParameters, "save_parameters", name=name)
        assert not refused.success
        assert "cannot be used" in refused.message
        assert not call(LoadParameters, "load_parameters", name=name).success

    assert call(Trigger, "reset").success
    now_running("literature")
    missing = call(LoadParameters, "load_parameters", name="cold")
    assert not missing.success
    assert "there is no" in missing.message
    (tmp_path / "broken.yaml").write_text("parameters: [1, 2")
    broken = call(LoadParameters, "load_parameters", name="broken")
    assert not broken.success
    assert "not valid YAML" in broken.message
    assert results.sets[-1].id == "literature"
    assert call(LoadParameters, "load_parameters", name="warm").success
    now_running(last)
    loaded = results.sets[-1]
    assert loaded.values == identified.values
    assert (identified.origin, loaded.origin) == (Origin.WINDOW, Origin.USER)
    identifier.stop()

    again = start("identifier", state_dir=tmp_path)
    heard = len(results.sets)
    listener.until(lambda: len(results.sets) > heard, "the set after the restart")
    assert str(results.sets[-1]) == str(loaded)
    os.kill(worker_pid(listener), 0)
    again.send_signal(signal.SIGKILL)
    again.wait()

    heard = len(results.sets)
    third = start("identifier", state_dir=tmp_path)
    listener.until(lambda: len(results.sets) > heard, "the set after the crash")
    assert str(results.sets[-1]) == str(loaded)
    third.stop()

    (tmp_path / "identifier.yaml").write_text("# mr_damper_ros parameters, half a li")
    heard = len(results.sets)
    start("identifier", state_dir=tmp_path)
    listener.until(lambda: len(results.sets) > heard, "the set after the damage")
    assert results.sets[-1].id == "literature"
    listener.wait_for_finding("identifier: state", "set aside as")
    assert (tmp_path / "identifier.aside").exists()
    acknowledged = call(Trigger, "acknowledge")
    assert acknowledged.success
    assert "set aside as" in acknowledged.message
    listener.wait_for_finding("identifier: state", "stored in")


def test_a_folder_and_a_name_are_of_one_identifier(
    start: Any, listener: Listener, results: Results, tmp_path: Path
) -> None:
    first = start("identifier", state_dir=tmp_path)
    results.wait_for_the_start()
    second = start("identifier", state_dir=tmp_path)
    assert second.wait() == 2
    assert_one_sentence(second.errors)
    assert f"in use by another node (process {first.pid})" in second.errors
    # The others may share the folder, but not the name.
    start("identifier", "--ros-args", "-r", "__ns:=/right", state_dir=tmp_path)
    for name, service in (("identifier", "/right/identifier"), ("right.identifier", "identifier")):
        refused = listener.call(
            SaveParameters, f"{service}/save_parameters", SaveParameters.Request(name=name)
        )
        assert not refused.success
        assert "is the state of another node" in refused.message


@pytest.fixture
def client(listener: Listener) -> Iterator[ActionClient]:
    client = ActionClient(listener.node, IdentifyGlobal, "identifier/identify_global")
    yield client
    client.destroy()


def finished(listener: Listener, future: Any, what: str) -> Any:
    listener.until(future.done, what)
    return future.result()


def test_every_goal_of_a_burst_is_answered(
    start: Any, listener: Listener, results: Results
) -> None:
    start("identifier")
    results.wait_for_the_start()
    # A client keeps ten answers by default, but this test is about the server.
    deep = {f"{name}_service_qos_profile": quality.lossless() for name in ("goal", "result")}
    client = ActionClient(listener.node, IdentifyGlobal, "identifier/identify_global", **deep)
    listener.until(client.server_is_ready, "the action server")
    answers = [client.send_goal_async(IdentifyGlobal.Goal()) for _ in range(100)]
    listener.until(lambda: all(answer.done() for answer in answers), "an answer to every goal")
    accepted = [answer.result() for answer in answers if answer.result().accepted]
    assert 0 < len(accepted) < len(answers)
    ended = [goal.get_result_async() for goal in accepted]
    listener.until(lambda: all(result.done() for result in ended), "the end of those accepted")
    client.destroy()


def test_a_global_identification_on_demand(
    start: Any, listener: Listener, results: Results, client: ActionClient
) -> None:
    feedback: list[IdentifyGlobal.Feedback] = []

    def send(**fields: Any) -> Any:
        feedback.clear()
        goal = IdentifyGlobal.Goal(**fields)
        future = client.send_goal_async(
            goal, feedback_callback=lambda message: feedback.append(message.feedback)
        )
        handle = finished(listener, future, "an answer to the goal")
        assert handle.accepted
        return handle

    def result(handle: Any) -> Any:
        return finished(listener, handle.get_result_async(), "the result")

    start("identifier", global_period=0)
    results.wait_for_the_start()
    listener.until(client.server_is_ready, "the action server")
    empty = result(send(generations=5))
    assert empty.status == GoalStatus.STATUS_ABORTED
    assert not empty.result.success
    assert empty.result.message

    searches = 1  # The search without windows has a report too.
    press = Press(listener)
    for round_, name in enumerate(("5.0mm_1Hz_0.0A", "5.0mm_1Hz_0.5A", "5.0mm_1Hz_1.5A")):
        run = read_bag(ROOT / "bags" / name)[0]
        press.run(replace(run, start_ns=run.start_ns + round_ * 10**10))
        results.wait_for_reports(searches + (round_ + 1) * WINDOWS)

    unknown = result(send(strategy="nonsense"))
    assert unknown.status == GoalStatus.STATUS_ABORTED
    assert "nonsense" in unknown.result.message

    whole = result(send(generations=20, seed=1))
    assert whole.status == GoalStatus.STATUS_SUCCEEDED
    assert whole.result.success
    assert whole.result.nrmse < 0.5
    assert whole.result.evaluations > 0
    assert feedback
    found = parameter_set(whole.result.parameters)
    assert found.current_range == pytest.approx((0.0, 1.5), abs=1e-9)
    results.wait_for_reports(searches + 3 * WINDOWS + 1)
    assert results.reports[-1].method == "differential_evolution"
    assert results.reports[-1].accepted == whole.result.accepted
    assert all(item.stage for item in feedback)
    (most,) = {item.generations for item in feedback}
    assert most % 20 == 0, "20 of each search"
    done = [item.generation for item in feedback]
    assert done == sorted(done)
    assert done[-1] <= most
    given = whole.result.parameters
    assert given.header.stamp.sec > 0
    if whole.result.accepted:
        listener.until(lambda: results.sets[-1].values == given.values, "the set in use")
        assert given.id == results.sets[-1].id
    else:
        assert given.id == "global-refused"

    endless = send(generations=10**6, seed=1)
    listener.until(lambda: feedback, "feedback")
    assert feedback[0].generations >= 10**6
    cancelled = finished(listener, endless.cancel_goal_async(), "an answer to the cancellation")
    assert len(cancelled.goals_canceling) == 1
    best = result(endless)
    assert best.status == GoalStatus.STATUS_CANCELED
    assert best.result.success
    assert "best result so far" in best.result.message
    assert len(best.result.parameters.values) == 16


def test_a_killed_worker_is_replaced_and_no_window_is_lost(
    start: Any, listener: Listener, results: Results, recording: Recording
) -> None:
    identifier = start("identifier")
    results.wait_for_the_start()
    press = Press(listener)
    first = worker_pid(listener)
    os.kill(first, signal.SIGKILL)
    press.run(recording)
    results.wait_for_reports(WINDOWS)
    second = worker_pid(listener)
    assert second != first
    # Stopped: it hangs, but is not dead.
    os.kill(second, signal.SIGSTOP)
    press.run(replace(recording, start_ns=recording.start_ns + 10**10))
    results.wait_for_reports(2 * WINDOWS)
    assert len({str(report.window_start) for report in results.reports}) == 2 * WINDOWS
    assert identifier.errors.count("the worker process died") == 1
    assert "the worker process hangs" in identifier.errors


@pytest.mark.parametrize(("number", "busy"), [(signal.SIGTERM, False), (signal.SIGKILL, True)])
def test_it_ends_cleanly_and_its_worker_with_it(
    start: Any,
    listener: Listener,
    results: Results,
    recording: Recording,
    number: signal.Signals,
    busy: bool,
) -> None:
    identifier = start("identifier")
    results.wait_for_the_start()
    worker = worker_pid(listener)
    if busy:
        Press(listener).run(recording)
        results.wait_for_reports(1)
    if number == signal.SIGKILL:
        identifier.send_signal(number)
        identifier.wait()
    else:
        identifier.stop(number)
    until(lambda: is_gone(worker), "the end of the worker")
