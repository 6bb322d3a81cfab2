"""Windows are cut by the data's stamps, independently of blocks and message order."""

import math
from bisect import bisect

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.signals.blocks import NANOSECONDS, CurrentError, SampleBlock, ZeroOrderHold
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowAssembler, WindowSettings

PERIOD = 1e-3
T0 = known.T0
COUNT = 3000
DISPLACEMENT = 5e-3 * np.sin(2.0 * np.pi * 5.0 * PERIOD * np.arange(COUNT))
FORCE = -np.arange(COUNT, dtype=float)


def at(seconds: float) -> int:
    """Stamp [ns] of a time after the first sample."""
    return T0 + round(seconds * NANOSECONDS)


def stream(*sizes: int, first: int = 0, last: int = COUNT) -> list[SampleBlock]:
    return known.blocks(
        DISPLACEMENT[first:last],
        FORCE[first:last],
        sizes,
        start_ns=at(first * PERIOD),
        sequence=first,
    )


def assembler(window: float = 1.0, hop: float = 0.5, current: float = 1.0) -> WindowAssembler:
    """An assembler whose current is known for the whole stream and beyond."""
    made = WindowAssembler(WindowSettings(window, hop, looks=0))
    made.add_current(at(0.0), current)
    made.add_current(at(100.0), current)
    return made


def cut(blocks: list[SampleBlock], made: WindowAssembler | None = None) -> list[RawWindow]:
    made = made or assembler()
    return [window for block in blocks for window in made.add_block(block)]


def starts(windows: list[RawWindow]) -> list[float]:
    """Start times [s] after the first sample."""
    return [round((window.start_ns - T0) / NANOSECONDS, 6) for window in windows]


# -- windows ---------------------------------------------------------------------------------


@known.fixed(25)
@given(
    st.lists(st.integers(1, 1500), min_size=1, max_size=10),
    st.sampled_from([(1.0, 0.5), (0.7, 0.7), (0.25, 0.1)]),
)
def test_windows_do_not_depend_on_the_size_of_the_blocks(
    sizes: list[int], lengths: tuple[float, float]
) -> None:
    expected = cut(stream(10), assembler(*lengths))
    found = cut(stream(*sizes), assembler(*lengths))
    assert starts(found) == starts(expected)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.displacement, other.displacement)
        np.testing.assert_array_equal(one.force, other.force)
        np.testing.assert_array_equal(one.current, other.current)


def test_a_changed_period_starts_the_window_again() -> None:
    made = assembler()
    cut(stream(100, last=800), made)
    other = known.blocks(
        np.zeros(600), np.zeros(600), [60], period=2e-3, start_ns=at(0.8), sequence=800
    )
    windows = cut(other, made)
    assert starts(windows) == [0.8]
    assert (windows[0].period, windows[0].force.size) == (2e-3, 500)
    assert "period changed" in made.take_events()[0]


def test_windows_keep_their_stamps_where_the_rate_is_not_the_nominal_one() -> None:
    # 200 parts per million for a minute: 12 ms, twelve samples.
    true_period = PERIOD * (1.0 + 2e-4)
    made = assembler(1.0, 0.5)
    windows = []
    for number in range(900):
        index = np.arange(70 * number, 70 * (number + 1), dtype=float)
        windows += made.add_block(
            SampleBlock(
                start_ns=at(float(index[0]) * true_period),
                sequence=int(index[0]),
                period=PERIOD,
                displacement=1e-3 * index,
                force=np.zeros(70),
            )
        )
    late = windows[-1]
    true_start = at(1e3 * float(late.displacement[0]) * true_period)
    assert abs(late.start_ns - true_start) <= 2e-3 * NANOSECONDS


@pytest.mark.parametrize(
    ("window", "hop", "sentence"),
    [
        (0.0, 0.1, "window must be from 0.01 to 3600, not 0"),
        (1.0, 0.0, "hop must be from 0.001 to 3600, not 0"),
        (1.0, 1.5, "hop (1.5 s) is longer than window (1 s)"),
    ],
)
def test_lengths_that_make_no_windows_are_refused(window: float, hop: float, sentence: str) -> None:
    with pytest.raises(ValueError) as caught:
        WindowAssembler(WindowSettings(window, hop, looks=0))
    assert sentence in str(caught.value)


# -- current ---------------------------------------------------------------------------------


def test_a_window_waits_until_its_current_is_known() -> None:
    made = WindowAssembler(WindowSettings(1.0, 1.0, looks=0))
    made.add_current(at(0.0), 0.5)
    assert cut(stream(100, last=1000), made) == []
    assert made.add_current(at(0.998), 0.5) == [], "the last sample has no current yet"
    windows = made.add_current(at(0.999), 0.5)
    assert starts(windows) == [0.0]
    np.testing.assert_array_equal(windows[0].current, 0.5)


def test_a_window_that_waits_for_a_moment_is_nothing_to_tell() -> None:
    made = WindowAssembler(WindowSettings(1.0, 1.0, looks=0))
    made.add_current(at(0.0), 0.5)
    cut(stream(100, last=1900), made)
    assert not made.waits_for_current
    cut(stream(100, first=1900, last=2100), made)
    assert made.waits_for_current
    made.add_current(at(2.1), 0.5)
    assert not made.waits_for_current


def test_a_window_that_began_before_the_current_was_known_is_dropped() -> None:
    made = WindowAssembler(WindowSettings(1.0, 0.5, looks=0))
    made.add_current(at(0.2), 0.5)
    made.add_current(at(5.0), 0.5)
    assert starts(cut(stream(100), made)) == [0.5, 1.0, 1.5, 2.0]


def test_the_next_look_replaces_a_window_that_is_dropped_for_its_current() -> None:
    made = WindowAssembler(WindowSettings(1.0, 0.4, looks=3))
    made.add_current(at(0.15), 0.5)
    made.add_current(at(5.0), 0.5)
    windows = cut(stream(100), made)
    assert starts(windows)[:4] == [0.2, 0.3, 0.4, 0.5]
    assert [bool(window.look) for window in windows[:4]] == [False, True, False, True]


@known.fixed(25)
@given(st.lists(st.integers(0, 3), min_size=12, max_size=12), st.integers(0, 40))
def test_windows_do_not_depend_on_when_the_current_arrives(turns: list[int], behind: int) -> None:
    values = [(at(0.1 * k), float(k % 7)) for k in range(50)]
    blocks = stream(100)
    expected = WindowAssembler(WindowSettings(1.0, 0.5, looks=0))
    for stamp, value in values:
        expected.add_current(stamp, value)
    reference = cut(blocks, expected)
    made, found, waiting = WindowAssembler(WindowSettings(1.0, 0.5, looks=0)), [], list(values)
    for number, block in enumerate(blocks):
        # Currents come in bursts, up to ``behind`` values later than the samples.
        for _ in range(turns[number % len(turns)] if number >= behind // 2 else 0):
            if waiting:
                found += made.add_current(*waiting.pop(0))
        found += made.add_block(block)
    for stamp, value in waiting:
        found += made.add_current(stamp, value)
    assert starts(found) == starts(reference)
    for one, other in zip(found, reference, strict=True):
        np.testing.assert_array_equal(one.current, other.current)


def test_after_a_jump_back_no_current_of_the_time_before_is_used() -> None:
    # The clock was set back: the current of the second pass is 2 A, but arrives late.
    made = WindowAssembler(WindowSettings(1.0, 1.0, looks=0))
    made.add_current(at(0.0), 1.0)
    made.add_current(at(3.0), 1.0)
    cut(stream(100, last=2500), made)
    windows = cut(stream(100, last=1000), made)
    for stamp in (0.0, 2.0):
        windows += made.add_current(at(stamp), 2.0)
    assert [float(w.current[0]) for w in windows] == [2.0]


def test_after_a_reset_the_window_starts_again() -> None:
    made = assembler()
    cut(stream(100, last=800), made)
    made.reset()
    assert made.fill == 0.0
    assert starts(cut(stream(100, first=800), made)) == [0.8, 1.3, 1.8]


# -- each value of the current holds until the stamp of the next one -------------------------------

MILLISECOND = 1_000_000


def hold(values: dict[int, float]) -> ZeroOrderHold:
    """Held currents [A], given by their time in milliseconds."""
    made = ZeroOrderHold(keep=60.0)
    for time, value in values.items():
        made.add(time * MILLISECOND, value)
    return made


def test_a_value_holds_from_its_stamp_to_the_next() -> None:
    made = hold({0: 1.0, 3: 2.0, 5: 3.0})
    for _ in range(2):  # the second time after the first result was overwritten
        found = made.at(0, PERIOD, 7)
        np.testing.assert_array_equal(found, [1.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0])
        found[:] = 9.0


def test_values_that_are_too_old_go_many_at_once() -> None:
    """Deletion moves all remaining values; after each of a million it would stall the stream."""
    made = ZeroOrderHold(keep=1.0)
    begins = []
    for time in range(5000):
        made.add(time * MILLISECOND, 1.0)
        begins.append(bisect(range(time), False, key=lambda t: made.known_from(t * MILLISECOND)))
    kept = np.arange(5000) - begins
    assert np.min(kept[1000:]) >= 1000
    assert np.max(kept) <= 2 * 1002
    assert np.count_nonzero(np.diff(begins)) < 50


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_value_that_is_not_finite_is_refused(value: float) -> None:
    made = hold({0: 1.0})
    with pytest.raises(CurrentError, match=f"the current is {value}: it must be a finite number"):
        made.add(MILLISECOND, value)
    assert made.last_stamp_ns == 0
