"""A tracker restarted from its stored state continues; unusable states are set aside."""

import copy
import dataclasses
import json
import math
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known import SIGMOID

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import FolderLock, LockHeldError
from mr_damper_ros.tracking.operating_point import KnownPoints
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker, run
from mr_damper_ros.tracking.tracker_state import TrackerMemory, TrackerState, from_text, to_text

START = ParameterSet(known.PLAUSIBLE, set_id="start")


def tracker() -> WindowTracker:
    return WindowTracker(TrackerSettings(method="least_squares", global_period=4), START)


def feed(tracked: WindowTracker, first: int, last: int) -> list[Report]:
    """Windows at two operating points of a damper that weakens; one window is too noisy."""
    reports = []
    for number in range(first, last):
        weaker = known.weaker(0.97**number)
        # A whole cycle; less would not determine the seven scales.
        run = known.run(
            weaker,
            current=(1.0, 1.5)[number % 2],
            samples=1000,
            noise=known.NOISE * (20.0 if number == 6 else 1.0),
            seed=number,
        )
        raw = known.raw_window(run, number=number, temperature=20.0 + number)
        reports.append(tracked.follow(raw))
    return reports


def resumed(tracked: WindowTracker) -> WindowTracker:
    """A new tracker with the stored state of another."""
    again = tracker()
    again.resume(tracked.parameters, from_text(to_text(tracked.memory), SIGMOID))
    return again


def test_a_tracker_goes_on_where_it_was() -> None:
    tracked = tracker()
    feed(tracked, 0, 7)  # the last window is rejected
    again = resumed(tracked)
    assert again.accepted_windows == tracked.accepted_windows > 2
    assert len(again.points.windows) == 2
    without_end, with_restart = feed(tracked, 7, 12), feed(again, 7, 12)
    assert {report.accepted for report in without_end} == {True}
    for one, other in zip(without_end, with_restart, strict=True):
        np.testing.assert_equal(dataclasses.asdict(other), dataclasses.asdict(one))
    assert to_text(again.memory) == to_text(tracked.memory)


def test_after_a_reset_the_damper_may_still_be_another_one() -> None:
    tracked = tracker()
    feed(tracked, 0, 3)
    tracked.reset()
    again = resumed(tracked)
    assert again.memory.other_damper
    feed(again, 3, 4)
    assert not resumed(again).memory.other_damper


def learnt() -> dict[str, Any]:
    """State of a tracker after a few windows, with a set to be confirmed, as parsed JSON."""
    tracked = tracker()
    feed(tracked, 0, 3)
    tracked.memory.rival = dataclasses.replace(tracked.parameters, set_id="rival")
    return json.loads(to_text(tracked.memory))


DOCUMENT = learnt()


def leaves(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all entries, including the nested ones."""
    found = [path] if path else []
    items = (
        data.items()
        if isinstance(data, dict)
        else enumerate(data)
        if isinstance(data, list)
        else ()
    )
    for key, value in items:
        found += leaves(value, (*path, key))
    return found


WRONG = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**30), 10**30),
    st.floats(),
    st.text(max_size=5),
    st.just({"shape": [2**60], "float64": ""}),
    st.just({"shape": [-1, -1], "float64": "AAAAAAAA8D8="}),
    st.lists(st.integers(), max_size=3),
)


@known.fixed(60)
@given(path=st.sampled_from(leaves(DOCUMENT)), wrong=WRONG)
def test_what_cannot_be_is_refused_or_does_no_harm(path: tuple[Any, ...], wrong: Any) -> None:
    document = copy.deepcopy(DOCUMENT)
    entry = document
    for key in path[:-1]:
        entry = entry[key]
    entry[path[-1]] = wrong
    try:
        memory = from_text(json.dumps(document), SIGMOID)
    except StateError:
        return
    again = tracker()
    again.resume(START, memory)
    for report in feed(again, 3, 5):
        assert report.scale.value > 0.0 or math.isnan(report.scale.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "cannot be used"),
        ("[" * 100_000, "cannot be used: maximum recursion"),
        ("null", "does not have the entries"),
        ('{"windows": 1' + "0" * 5000 + "}", "cannot be used"),
        ('{"future": 1}', "does not have the entries"),
    ],
)
def test_other_texts_are_refused(text: str, sentence: str) -> None:
    with pytest.raises(StateError, match=sentence):
        from_text(text, SIGMOID)


@pytest.mark.parametrize(
    ("entry", "wrong", "sentence"),
    [
        pytest.param("windows", 10**250, "is out of range", id="name too long"),
        ("windows", -1, "is out of range"),
        ("windows", True, "has the wrong type"),
        ("seen_ns", 2**63, "is out of range"),
        ("level", 0.0, "level is not positive"),
        ("watch", DOCUMENT["watch"] | {"block": 0}, "a count is zero"),
        ("current_lag", {"costs": {"shape": [0], "float64": ""}}, "0 lags are compared"),
        (
            "rival",
            known.controllable("bingham").to_yaml(),
            "the set to be confirmed is not plausible",
        ),
        (
            "rival",
            dataclasses.replace(START, nrmse=5.0).to_yaml(),
            "the set to be confirmed is not plausible",
        ),
    ],
)
def test_what_would_harm_every_window_is_refused(entry: str, wrong: Any, sentence: str) -> None:
    assert from_text(json.dumps(DOCUMENT), SIGMOID).rival is not None
    with pytest.raises(StateError, match=sentence):
        from_text(json.dumps(DOCUMENT | {entry: wrong}), SIGMOID)


def test_the_memory_of_another_model_is_refused() -> None:
    with pytest.raises(StateError, match="number of parameters"):
        from_text(json.dumps(DOCUMENT | {"rival": None}), MODELS["sigmoid_lag"])


def test_windows_that_do_not_travel_stay_where_they_are() -> None:
    tracked = tracker()
    feed(tracked, 0, 4)
    raw = known.raw_window(known.run(samples=1000, seed=4))
    for window, changed in ((dataclasses.replace(raw, look=250), 0), (raw, 1)):
        before = tracked.points.windows
        job = pickle.loads(pickle.dumps(tracked.job_of(window)))
        outcome = pickle.loads(pickle.dumps(run(job)))
        assert len(outcome.memory.points.windows) == changed
        tracked.complete(outcome)
        stay = [any(one is other for other in tracked.points.windows) for one in before]
        assert stay.count(False) == changed
    assert len(tracked.points.windows) == len(before) == 2


def test_a_place_beyond_the_window_is_refused() -> None:
    time = np.arange(400) * 1e-3
    window = Window.from_samples(time**2, time, 1.0, 1e-3).part(slice(None, None, 2))
    wrong = dataclasses.replace(window, places=np.asarray(window.places) + 2.0)
    memory = TrackerMemory(KnownPoints().with_window(wrong, window.operating_point))
    with pytest.raises(StateError, match="a place is outside"):
        from_text(to_text(memory), SIGMOID)


# -- the state survives in its folder, and an unusable file is set aside ---------------------------

FIRST = ParameterSet(known.weaker(0.8), set_id="start")


def state_in(folder: Path | str, name: str = "identifier") -> tuple[WindowTracker, TrackerState]:
    tracker = WindowTracker(TrackerSettings(method="least_squares"), FIRST)
    return tracker, TrackerState(StateDirectory(folder), name)


def taught(folder: Path) -> tuple[WindowTracker, TrackerState]:
    tracker, state = state_in(folder)
    state.resume(tracker)
    tracker.follow(known.raw_window(known.run(samples=1000)))
    assert tracker.accepted_windows == 1
    assert state.keep_now(tracker) == ""
    return tracker, state


def test_a_tracker_goes_on_where_another_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, state = taught(tmp_path)
    monkeypatch.setattr("os.fsync", lambda file: time.sleep(0.05))
    state.keep(before)
    state.close()
    assert state.writer.done == state.writer.given
    after, again = state_in(tmp_path)
    assert again.resume(after) == "parameters window-1 and 1 baselines, 1 windows"
    assert again.writer.fault == again.set_aside == ""
    assert after.parameters.set_id == "window-1"
    np.testing.assert_array_equal(after.parameters.values, before.parameters.values)
    assert after.accepted_windows == 1
    again.close()


def test_the_initial_set_is_kept_at_once(tmp_path: Path) -> None:
    tracker, state = state_in(tmp_path / "new")
    assert state.resume(tracker) == ""
    assert (tmp_path / "new" / "identifier.yaml").exists()
    state.close()


def test_what_was_set_aside_is_told_at_every_start_until_it_is_acknowledged(tmp_path: Path) -> None:
    (tmp_path / "identifier.yaml").write_text("half a fi")
    for part in ("mapping 'parameters'", "set aside as"):
        tracker, state = state_in(tmp_path)
        state.resume(tracker)
        assert part in state.set_aside
        state.close()
    tracker, state = state_in(tmp_path)
    state.resume(tracker)
    assert str(tmp_path / "identifier.aside") in state.acknowledge()
    assert state.set_aside == ""
    state.close()
    tracker, later = state_in(tmp_path)
    later.resume(tracker)
    assert later.set_aside == ""
    assert (tmp_path / "identifier.aside-read").read_text() == "half a fi"
    later.close()


def test_a_folder_and_a_name_are_of_one_tracker_at_a_time(tmp_path: Path) -> None:
    _, state = taught(tmp_path)
    tracker, second = state_in(tmp_path)
    with pytest.raises(StateError, match=rf"in use by another node \(process {os.getpid()}\)"):
        second.resume(tracker)
    state_of_another_name = state_in(tmp_path, "left.identifier")[1]
    state_of_another_name.resume(tracker)
    state_of_another_name.close()
    state.close()
    assert second.resume(tracker) != ""
    second.close()


def test_a_killed_process_leaves_no_lock(tmp_path: Path) -> None:
    hold = (
        "import sys; from pathlib import Path; "
        "from mr_damper_ros.processes.files import FolderLock; "
        "lock = FolderLock(Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    )
    path = tmp_path / ".identifier.lock"
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(LockHeldError) as caught:
            FolderLock(path)
        assert caught.value.holder == holder.pid
        holder.kill()
    FolderLock(path).release()


def test_the_state_of_another_tracker_is_not_replaced(tmp_path: Path) -> None:
    tracker, left = state_in(tmp_path, "left.identifier")
    left.resume(tracker)
    tracker, right = taught(tmp_path)
    before = (tmp_path / "left.identifier.yaml").read_bytes()
    with pytest.raises(StateError, match="is the state of another node"):
        right.save("left.identifier", tracker)
    left.close()
    with pytest.raises(StateError, match="is the state of another node"):
        right.save("left.identifier.yaml", tracker)
    assert (tmp_path / "left.identifier.yaml").read_bytes() == before
    right.close()


def test_a_set_that_the_next_start_would_refuse_is_not_kept(tmp_path: Path) -> None:
    tracker, state = taught(tmp_path)
    good = (tmp_path / "identifier.yaml").read_bytes()
    tracker.parameters = ParameterSet(-known.weaker(0.8), set_id="driving", nrmse=5.0)
    assert "driving is not stored: the parameters state an nrmse of 5" in state.keep_now(tracker)
    assert (tmp_path / "identifier.yaml").read_bytes() == good
    state.close()


def test_sets_are_kept_under_names_beside_the_own_one(tmp_path: Path) -> None:
    tracker, state = taught(tmp_path)
    assert state.save("cold", tracker) == tmp_path / "cold.yaml"
    assert state.save("", tracker) == state.path == tmp_path / "identifier.yaml"
    assert state.load("cold").set_id == "window-1"
    tracker.reset()
    assert state.load("").set_id == "window-1", "nothing was kept since"
    state.close()


def test_a_state_of_another_format_is_refused_and_stays_on_disk(tmp_path: Path) -> None:
    _, state = taught(tmp_path)
    state.close()
    path = tmp_path / "identifier.yaml"
    path.write_text(old := path.read_text().replace("version 3", "version 2"))
    tracker, again = state_in(tmp_path)
    assert again.resume(tracker) == ""
    again.keep_now(tracker)
    again.close()
    assert "has version 2 of the format, but this mr_damper_ros reads only version 3" in (
        again.set_aside
    )
    assert tracker.parameters.set_id == FIRST.set_id
    assert (tmp_path / "identifier.aside").read_text() == old
    # What the sentence advises.
    (tmp_path / "set.yaml").write_text(old.partition("\n")[2])
    assert again.load("set").set_id == "window-1"
