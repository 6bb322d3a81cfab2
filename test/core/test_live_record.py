"""The record of a running system and its tables, and the data that its viewers receive."""

import json
import math
from typing import Any

import known
import numpy as np
import pytest
import running_damper
from hypothesis import given
from hypothesis import strategies as st
from waiting import SetClock

from mr_damper_ros.live import live_record
from mr_damper_ros.live.live_record import Concern, LiveRecord, RollingTable, first_of_two
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tools.watch import summary
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.reports import Report

T0 = 1_700_000_000.0


def signals(record: LiveRecord, *times: float) -> None:
    for stamp in times:
        running_damper.add_signals(record, stamp, 0.001, 0.02, 0.5, 400.0, 380.0, valid=True)


def add_window(record: LiveRecord, time: float = T0, **coefficients: float) -> None:
    values = np.array([*coefficients.values()])
    report = Report(
        window_start_ns=round((time - 1.0) * 1e9),
        stamp_ns=round(time * 1e9),
        sample_count=1000,
        method="nelder_mead",
        verdict=Verdict.ACCEPTED,
        nrmse_before=0.1,
        reason="it predicts better",
        set_id="nm-1",
        coefficient_names=tuple(coefficients),
        coefficients=values,
        coefficient_errors=0.1 * values,
    )
    record.add_report(report, 0.01)


def a_set(*, stamp_ns: int = round(T0 * 1e9), observable: bool = True) -> ParameterSet:
    return ParameterSet(
        known.PLAUSIBLE,
        0.1 * np.abs(known.PLAUSIBLE),
        np.full(known.PLAUSIBLE.size, observable),
        set_id="nm-1",
        source="nelder_mead",
        stamp_ns=stamp_ns,
    )


def status(record: LiveRecord, windows_after: int = 0) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    text = json.dumps(record.status(windows_after))
    return json.loads(text, parse_constant=refuse)


def test_a_viewer_asks_for_what_it_has_not_got() -> None:
    record = LiveRecord()
    signals(record, T0, T0 + 0.01)
    first = record.rows("signals", -1, -1)
    signals(record, T0 + 0.02)
    more = record.rows("signals", int(first.values[-1, 0]), first.generation)
    assert more.values[:, 1].tolist() == [T0 + 0.02]


def test_where_the_stamps_fall_back_everything_begins_anew() -> None:
    record = LiveRecord()
    signals(record, T0 + 100.0)
    add_window(record, T0 + 100.0)
    before = record.rows("signals", -1, -1)
    signals(record, T0)
    after = record.rows("signals", 0, before.generation)
    windows = record.rows("windows", -1, -1)
    assert after.generation != before.generation
    assert after.values[:, 1].tolist() == [T0]
    assert len(windows.values) == 0


def test_a_set_is_known_from_the_beginning_of_another_recording_or_from_no_samples() -> None:
    record = LiveRecord()
    record.set_parameters(a_set(stamp_ns=0))
    first = record.rows("parameters", -1, -1)
    assert math.isnan(first.values[0, 1])
    signals(record, T0 + 100.0)
    record.set_parameters(a_set(stamp_ns=0))
    signals(record, T0)
    rows = record.rows("parameters", -1, -1)
    assert len(rows.values) == 1
    assert math.isnan(rows.values[0, 1])


def test_the_status_is_json_even_of_what_is_not_known() -> None:
    record = LiveRecord()
    assert status(record)["set"] is None
    assert status(record)["silence"] is None
    signals(record, T0)
    add_window(record)
    record.set_parameters(a_set())
    record.add_concern(Concern("model: input", 1, "nothing comes", {"lost": "3"}))
    record.add_event("saved")
    told = status(record)
    assert told["set"]["nrmse"] is None
    assert told["windows"][0]["nrmse_after"] is None
    assert told["windows"][0]["reason"] == "it predicts better"
    assert told["concerns"][0]["values"] == {"lost": "3"}
    assert told["events"] == ["saved"]
    assert told["tables"]["signals"]["next"] == 1
    assert told["silence"] >= 0.0


def test_nothing_grows_without_end() -> None:
    record = LiveRecord()
    for number in range(3 * live_record.SENTENCES_KEPT):
        add_window(record)
        record.add_concern(Concern(f"node{number}: input", 0, "", {}))
        record.add_event("again")
    told = status(record)
    assert len(told["windows"]) == len(told["events"]) == live_record.SENTENCES_KEPT
    assert len(told["concerns"]) == live_record.CONCERNS_KEPT


def test_a_summary_says_what_is_missing_and_how_it_stands() -> None:
    record = LiveRecord()
    assert "is the node model running" in summary(record)
    assert "is the node identifier running" in summary(record)
    signals(record, T0, T0 + 0.01)
    add_window(record, f_t=500.0)
    record.set_parameters(a_set(observable=False))
    record.add_concern(Concern("model: input", 1, "nothing comes", {}))
    text = summary(record, width=100)
    for part in ("accepted", "f_t", "500 ± 50", "f0 ", "(not determined)", "! model: input"):
        assert part in text
    assert max(map(len, text.splitlines())) <= 100


def test_a_summary_says_that_there_is_no_set_and_no_current() -> None:
    record = LiveRecord()
    running_damper.add_signals(record, T0, 0.001, 0.02, math.nan, 400.0, math.nan, valid=False)
    record.add_report(Report(window_start_ns=0, stamp_ns=1, set_id=""), 0.01)
    text = summary(record, width=100)
    assert "predicted unknown (no parameters yet)" in text
    assert "current unknown" in text
    assert "nan" not in text


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


def faults(record: LiveRecord) -> list[tuple[str, bool, bool]]:
    return [(fault["name"], fault["active"], fault["seen"]) for fault in status(record)["faults"]]


def test_a_fault_stays_until_it_is_over_and_seen(clock: SetClock) -> None:
    record = LiveRecord(clock)
    wrong, good = (Concern("supply: current", level, "no load", {}) for level in (2, 0))
    record.add_concern(wrong)
    assert faults(record) == [("supply: current", True, False)]
    record.add_concern(good)
    assert faults(record) == [("supply: current", False, False)]
    number = status(record)["faults"][0]["number"]
    record.add_concern(wrong)
    record.acknowledge(number)
    assert faults(record) == [("supply: current", True, False)], "it has come back since"
    record.acknowledge(status(record)["faults"][0]["number"])
    assert faults(record) == [("supply: current", True, True)]
    record.add_concern(good)
    assert faults(record) == []


def test_a_node_that_died_is_a_fault_until_seen_also_where_nobody_looked(clock: SetClock) -> None:
    record = LiveRecord(clock)
    record.add_concern(Concern("supply: current", 0, "0.5 A", {}))
    clock.now += 12.0
    record.add_concern(Concern("supply: current", 0, "0.5 A", {}))
    record.add_concern(Concern("replay: replay", 0, "the recording has ended", {"ended": "yes"}))
    assert faults(record) == [("supply", False, False)]
    assert status(record)["faults"][0]["since"] == 0.0
    clock.now += 12.0
    assert faults(record) == [("supply", True, False)]


def follow(record: LiveRecord, begin: float, duration: float, current: float) -> None:
    for number in range(round(100.0 * duration)):
        at = begin + 0.01 * number
        force = 400.0 if number % 10 else 900.0
        running_damper.add_signals(
            record, T0 + at, 0.001, 0.02, current, force, 380.0, valid=number % 2 == 0
        )


def marks(record: LiveRecord) -> list[tuple[str, str]]:
    return [(mark["kind"], mark["text"]) for mark in status(record)["marks"]]


def test_the_history_has_the_range_of_each_tenth_of_a_second() -> None:
    record = LiveRecord()
    follow(record, 0.0, 1.0, 0.5)
    rows = record.rows("history", -1, -1)
    found = dict(zip(rows.columns, rows.values[0], strict=True))
    assert found["time"] == T0
    assert (found["measured_force_low"], found["measured_force_high"]) == (400.0, 900.0)
    assert (found["force_error_low"], found["force_error_high"]) == (-520.0, -20.0)
    assert found["valid"] == 0.5
    assert len(rows.values) == 9


def test_joined_rows_of_the_history_keep_the_whole_range(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_record, "HISTORY_KEPT", 8)
    record = LiveRecord()
    follow(record, 0.0, 2.0, 0.5)
    rows = record.rows("history", -1, -1)
    high = rows.columns.index("measured_force_high")
    assert len(rows.values) <= 8
    assert rows.values[0, 1] == T0
    assert np.all(rows.values[:, high] == 900.0)


def test_a_step_of_the_current_is_marked_where_both_levels_are_held() -> None:
    record = LiveRecord()
    follow(record, 0.0, 1.0, 0.5)
    follow(record, 1.0, 1.0, 1.5)
    assert marks(record) == [("current", "0.5 to 1.5 A")]
    assert status(record)["marks"][0]["time"] == pytest.approx(T0 + 1.0)


def test_a_current_under_control_is_not_marked() -> None:
    record = LiveRecord()
    follow(record, 0.0, 1.0, 0.5)
    for number in range(100):
        follow(record, 1.0 + 0.1 * number, 0.1, 0.5 + 0.1 * (number % 7))
    assert marks(record) == []


def test_sets_and_faults_are_marked_until_the_stamps_fall_back() -> None:
    record = LiveRecord()
    signals(record, T0 + 100.0)
    record.set_parameters(a_set())
    record.add_concern(Concern("supply: supply", 2, "tripped", {}))
    record.add_concern(Concern("supply: supply", 2, "tripped, still", {}))
    assert marks(record) == [("set", "nm-1 (nelder mead)"), ("fault", "supply: supply: tripped")]
    signals(record, T0)
    assert marks(record) == []


def test_what_is_commanded_is_shown_as_long_as_it_is_heard() -> None:
    clock = 0.0
    record = LiveRecord(lambda: clock)
    record.set_point("desired_force", 300.0)
    signals(record, T0)
    clock = 10.0
    signals(record, T0 + 0.01)
    rows = record.rows("signals", -1, -1)
    desired = rows.values[:, rows.columns.index("desired_force")]
    assert desired[0] == 300.0
    assert math.isnan(desired[1])


def test_samples_are_kept_at_the_full_rate() -> None:
    record = LiveRecord()
    block = np.arange(10.0)
    record.add_samples(T0, 1e-3, block, 2.0 * block, 3.0 * block, np.ones(10))
    rows = record.rows("samples", -1, -1)
    np.testing.assert_allclose(np.diff(rows.values[:, 1]), 1e-3, rtol=1e-3)
    np.testing.assert_array_equal(rows.values[:, 4], 3.0 * block)


def test_samples_give_signals_with_the_slope_of_the_displacement_and_the_current() -> None:
    record = LiveRecord()
    record.add_current(T0, 0.5)
    record.add_current(T0 + 0.25, 1.5)
    for block in range(5):
        at = 0.1 * block + 1e-3 * np.arange(100)
        u = 5e-3 * np.sin(2.0 * math.pi * at)
        record.add_samples(T0 + 0.1 * block, 1e-3, u, 2.0 * u, 3.0 * u, np.ones(100))
    rows = record.rows("signals", -1, -1)
    found = dict(zip(rows.columns, rows.values.T, strict=True))
    at = found["time"] - T0
    assert np.all(np.abs(np.diff(at)[1:] - 0.01) < 1.1e-3)
    expected = 0.01 * math.pi * np.cos(2.0 * math.pi * at)
    np.testing.assert_allclose(found["velocity"], expected, atol=2e-5)
    np.testing.assert_array_equal(found["current"], np.where(at < 0.25, 0.5, 1.5))


# -- tables of limited size: dropped rows, thinning, and the data for readers ---------------------


def filled(rows: int, capacity: int = 8, *, thins: bool = False) -> RollingTable:
    table = RollingTable(("value",), capacity, first_of_two if thins else None)
    for number in range(rows):
        table.extend([(10.0 * number,)])
    return table


def test_a_full_table_loses_its_oldest_rows() -> None:
    assert filled(9).after(-1)[:, 0].tolist() == [2, 3, 4, 5, 6, 7, 8]


def test_one_that_thins_keeps_the_whole_time_in_view() -> None:
    assert filled(9, thins=True).after(-1)[:, 0].tolist() == [0, 2, 4, 5, 6, 7, 8]


def test_rows_that_are_given_out_do_not_change_later() -> None:
    table = filled(8)
    given_out = table.after(-1)
    for _ in range(8):
        table.extend([(-1.0,)])
    assert given_out[:, 1].tolist() == [10.0 * n for n in range(8)]


@given(rows=st.integers(0, 200), capacity=st.integers(8, 40), thins=st.booleans())
def test_numbers_rise_the_newest_is_there_and_the_memory_bounded(
    rows: int, capacity: int, thins: bool
) -> None:
    table = filled(rows, capacity, thins=thins)
    numbers = table.after(-1)[:, 0]
    assert numbers.size <= capacity
    assert np.all(np.diff(numbers) > 0)
    assert rows == 0 or numbers[-1] == rows - 1
    if thins and rows:
        assert numbers[0] == 0
