"""Many recordings, each identified by itself: by any executor, with errors and killed workers."""

import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import known
import numpy as np
import pytest

import mr_damper_ros as mr
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings, scaled
from mr_damper_ros.emulation.motions import SineMotion

PATIENCE = 60.0
"""Seconds after which a wait fails."""

OPTIONS = {"method": "least_squares"}
BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"


def made(strength: float, seconds: float = 1.0) -> mr.Recording:
    rig = EmulatedRig(
        EmulatedDamper(scaled(known.PLAUSIBLE, strength)),
        SineMotion(5e-3, 4.0),
        1.0,
        settings=RigSettings(sample_rate=500.0),
    )
    return rig.record(seconds)


def resting() -> mr.Recording:
    still = np.zeros(500)
    return mr.Recording("resting", 0, 2e-3, still, still, still)


GOOD = [made(1.0), [made(0.7), made(0.7, 2.0)], made(1.3)]
"""The second result is from two runs."""


def reading(number: int) -> mr.Recording:
    raise ValueError("cannot be read again")


class Unreadable(os.PathLike):
    """A path whose pickle cannot be read."""

    def __fspath__(self) -> str:
        return "unreadable"

    def __reduce__(self) -> Any:
        return reading, (1,)


BAD = ["nowhere", resting(), lambda: None, [], Unreadable()]


@contextmanager
def dask() -> Iterator[Executor]:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(2, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client.get_executor()


def values(result: mr.IdentifiedRecording | mr.Identification) -> dict[str, Any]:
    """Everything in the result but the computing time."""
    document = result.document if isinstance(result.document, dict) else result.document()
    return {name: value for name, value in document.items() if name != "duration_s"}


@pytest.fixture(scope="module")
def single() -> list[mr.Identification]:
    return [mr.identify(recording, **OPTIONS) for recording in GOOD]


@pytest.fixture(scope="module")
def found() -> list[mr.IdentifiedRecording]:
    """Results of the default processes, good ones first."""
    return mr.identify_many([*GOOD, *BAD], workers=2, **OPTIONS)


def test_processes_give_the_same_as_identify(
    found: list[mr.IdentifiedRecording], single: list[mr.Identification]
) -> None:
    assert [values(one) for one in found[: len(GOOD)]] == [values(one) for one in single]


def test_an_error_is_only_in_its_own_row(found: list[mr.IdentifiedRecording]) -> None:
    assert [bool(row.error) for row in found] == [False] * len(GOOD) + [True] * len(BAD)
    assert found[len(GOOD)].error == "there is no bag at nowhere"
    assert found[len(GOOD) + 1].name == "resting"
    assert all(row.to_dict()["success"] is not bool(row.error) for row in found)


@pytest.mark.parametrize("executor", [lambda: ThreadPoolExecutor(2), dask], ids=["threads", "dask"])
def test_any_executor_gives_the_same_as_identify(
    executor: Any, single: list[mr.Identification]
) -> None:
    with executor() as given:
        first, failed, *others = mr.identify_many([GOOD[0], *BAD[:1], *GOOD[1:]], given, **OPTIONS)
    assert [values(one) for one in (first, *others)] == [values(one) for one in single]
    assert failed.error == "there is no bag at nowhere"


def test_a_result_survives_pickle(found: list[mr.IdentifiedRecording]) -> None:
    (again, *_) = pickle.loads(pickle.dumps(found))
    assert again.to_dict() == found[0].to_dict()
    assert again.parameter_set.to_yaml() == found[0].parameter_set.to_yaml()


def test_a_row_is_plain_json(found: list[mr.IdentifiedRecording]) -> None:
    row = found[0].to_dict()
    assert json.loads(json.dumps(row, allow_nan=False)) == row
    assert any(name.endswith("_standard_error") and value for name, value in row.items())


@pytest.mark.parametrize(
    ("recordings", "options", "error"),
    [
        ("bags/run", {}, ValueError),
        (Path("bags/run"), {}, ValueError),
        (BAD, {"resume": "progress.json"}, ValueError),
        (BAD, {"displacement": np.zeros(9)}, ValueError),
        (BAD, {"metod": "global"}, TypeError),
        (BAD, {"workers": 0}, ValueError),
        (BAD, {"workers": 1, "executor": ThreadPoolExecutor(1)}, ValueError),
    ],
)
def test_an_option_for_no_recording_is_refused(
    recordings: Any, options: dict[str, Any], error: type[Exception]
) -> None:
    with pytest.raises(error):
        mr.identify_many(recordings, **options)


def children() -> set[int]:
    """Ids of the child processes."""
    lists = Path("/proc/self/task").glob("*/children")
    return {int(number) for each in lists for number in each.read_text().split()}


def test_the_work_of_killed_processes_is_repeated() -> None:
    before, killed = children(), set[int]()

    def kill(row: mr.IdentifiedRecording, count: int, total: int) -> None:
        if not killed:
            killed.update(children() - before)
            for process in killed:
                os.kill(process, signal.SIGKILL)

    found = mr.identify_many([BAG] * 4, workers=2, report=kill)
    assert len(killed) == 2
    assert [row.error for row in found] == [""] * 4


def test_results_survive_a_killed_process_of_an_executor() -> None:
    def kill(row: mr.IdentifiedRecording, count: int, total: int) -> None:
        for process in multiprocessing.active_children():
            process.kill()

    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as executor:
        found = mr.identify_many([BAG] * 4, executor, report=kill)
    assert found[0].error == ""
    assert "process" in found[3].error


INTERRUPTED = """
import sys
sys.path[:] = {path!r}
from pathlib import Path
import mr_damper_ros as mr

def report(row, count, total):
    if count == 1:
        lists = Path("/proc/self/task").glob("*/children")
        print(*(each.read_text() for each in lists), flush=True)

mr.identify_many([{bag!r}] * 1000, workers=2, report=report)
"""


def test_ctrl_c_ends_the_program_and_its_processes() -> None:
    code = INTERRUPTED.format(path=sys.path, bag=str(BAG))
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        started = [int(number) for number in program.stdout.readline().split()]
        program.send_signal(signal.SIGINT)
        _, said = program.communicate(timeout=PATIENCE)
    assert "KeyboardInterrupt" in said
    assert len(started) == 2
    assert not any(Path(f"/proc/{process}").exists() for process in started)


def test_results_are_reported_as_they_are_completed() -> None:
    heard: list[tuple[str, int, int]] = []
    with ThreadPoolExecutor(1) as executor:
        mr.identify_many(
            ["nowhere", "missing"],
            executor,
            report=lambda row, count, total: heard.append((row.name, count, total)),
        )
    assert heard == [("nowhere", 1, 2), ("missing", 2, 2)]
