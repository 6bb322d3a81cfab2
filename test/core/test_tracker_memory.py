"""A tracker that is started again from what it wrote goes on as if it had never stopped."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
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
from mr_damper_ros.tracking.jobs import TRACKERS
from mr_damper_ros.tracking.operating_point import Kept, KnownPoints
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.state_directory import StateError
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.tracker_state import TrackerMemory, from_text, to_text

START = ParameterSet(known.PLAUSIBLE, set_id="start")


def tracker(**changes: Any) -> WindowTracker:
    entries: dict[str, Any] = {"method": "least_squares", "global_period": 4, **changes}
    return WindowTracker(TrackerSettings(**entries), START)


def feed(tracked: WindowTracker, first: int, last: int) -> list[Report]:
    """Windows at two operating points, whose damper gets weaker and, once, too noisy."""
    reports = []
    for number in range(first, last):
        weaker = known.weaker(0.97**number)
        # A whole cycle: less does not determine the seven scales.
        run = known.run(
            weaker,
            current=(1.0, 1.5)[number % 2],
            samples=1000,
            noise=known.NOISE * (20.0 if number == 6 else 1.0),
            seed=number,
        )
        raw = known.raw_window(run, number=number, temperature=20.0 + number)
        report = tracked.follow(raw)
        assert report is not None
        reports.append(report)
    return reports


def resumed(tracked: WindowTracker, **changes: Any) -> WindowTracker:
    """A new tracker, from the text of another."""
    again = tracker(**changes)
    again.resume(tracked.parameters, from_text(to_text(tracked.memory), SIGMOID))
    return again


@pytest.mark.parametrize("kind", TRACKERS)
def test_a_tracker_goes_on_where_it_was(kind: str) -> None:
    tracked = tracker(tracker=kind)
    feed(tracked, 0, 7)  # the last window is refused
    again = resumed(tracked, tracker=kind)
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
    """The text of a tracker that has seen a few windows, as JSON gives it."""
    tracked = tracker(tracker="recursive")
    feed(tracked, 0, 3)
    document: dict[str, Any] = json.loads(to_text(tracked.memory))
    return document


DOCUMENT = learnt()


def leaves(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all entries, the inner ones too."""
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
    again = tracker(tracker="recursive")
    again.resume(START, memory)
    for report in feed(again, 3, 5):
        assert report.scale.value > 0.0 or math.isnan(report.scale.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "cannot be used"),
        ("[" * 100_000, "nested too deeply"),
        ("null", "does not have the entries"),
        ('{"windows": 1' + "0" * 5000 + "}", "cannot be used"),
        ('{"windows": -1}', "an invalid count"),
        ('{"future": 1}', "does not have the entries"),
    ],
)
def test_other_texts_are_refused(text: str, sentence: str) -> None:
    with pytest.raises(StateError, match=sentence):
        from_text(text, SIGMOID)


def test_the_memory_of_another_model_is_refused() -> None:
    with pytest.raises(StateError, match="number of parameters"):
        from_text(json.dumps(DOCUMENT), MODELS["sigmoid_lag"])


def test_a_place_beyond_the_window_is_refused() -> None:
    time = np.arange(400) * 1e-3
    window = Window.from_samples(time**2, time, 1.0, 1e-3).part(slice(None, None, 2))
    wrong = dataclasses.replace(window, places=np.asarray(window.places) + 2.0)
    memory = TrackerMemory(KnownPoints().with_window(Kept(wrong, window.operating_point)))
    with pytest.raises(StateError, match="an invalid place"):
        from_text(to_text(memory), SIGMOID)
