"""Many dampers from many recordings: the whole procedure, and the handling of bad files."""

import csv
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import known
import numpy as np
import pytest

import mr_damper_ros as mr
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings, scaled
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.lots.population import KnownDamper, Population
from mr_damper_ros.lots.report import write_population_report
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tools import identify_many

COLUMNS = "displacement:mm,force:N,current:A"
STRENGTHS = {"D1": 1.0, "D2": 1.01, "D3": 0.99, "D4": 0.7, "D5": 1.02, "D6": 0.98}
"""Force of each damper of the lot relative to the normal one; D4 has lost its gas."""


def made(strength: float, current: float, seed: int) -> mr.Recording:
    rig = EmulatedRig(
        EmulatedDamper(scaled(known.PLAUSIBLE, strength)),
        SineMotion(5e-3, 4.0),
        current,
        settings=RigSettings(sample_rate=500.0, seed=seed),
    )
    return rig.record(0.5)


def record(path: Path, strength: float, current: float, seed: int) -> None:
    run = made(strength, current, seed)
    rows = np.column_stack((1e3 * run.displacement, run.force, run.current))
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, fmt="%.7g", delimiter=",")


@pytest.fixture(scope="module")
def lot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six dampers with one run each (D1 also has a bag) and two unusable files."""
    root = tmp_path_factory.mktemp("lot")
    for seed, (name, strength) in enumerate(STRENGTHS.items()):
        record(root / name / "1A.csv", strength, 1.0, seed)
    bag = tmp_path_factory.mktemp("bag") / "run"
    mr.write_bag(bag, made(1.0, 0.2, 9))
    (bag / "run.mcap").rename(root / "D1" / "0.2A.mcap")
    (root / "D2" / "broken.csv").write_text("nothing\n")
    (root / "D7").mkdir()
    (root / "D7" / "empty.csv").touch()
    return root


def options(lot: Path) -> dict[str, Any]:
    return {"columns": COLUMNS, "period": 2e-3, "method": "least_squares"}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("results")


@pytest.fixture(scope="module")
def found(lot: Path, results: Path) -> mr.ManyDampers:
    with ThreadPoolExecutor(1) as executor:
        return mr.identify_many(lot, folder=results, executor=executor, **options(lot))


def test_a_lot_is_identified_and_what_is_bad_or_odd_is_named(found: mr.ManyDampers) -> None:
    rows = {row["damper"]: row for row in found.table}
    assert {name for name, row in rows.items() if row["identified"]} == set(STRENGTHS)
    assert rows["D1"]["recordings"] == 2
    assert all(rows[name]["nrmse"] < 0.02 for name in STRENGTHS)
    named = {entry.path.name: entry.reason for entry in found.left_out}
    assert set(named) == {"broken.csv", "empty.csv"}
    assert all(named.values())
    assert found.failures == {"D7": "none of its recordings could be used"}
    (outlier,) = [one for one in found.population.outliers if one.unit == "N"]
    assert outlier.damper == "D4"
    assert "D4: force at" in outlier.sentence
    spread = next(s for s in found.population.forces if s.known.size == len(STRENGTHS))
    dampers = found.population.dampers
    usual = spread.values[[d.name for d in dampers].index("D1")]
    expected = usual * np.array([STRENGTHS[d.name] for d in dampers])
    # Six dampers at a few points each: one in a thousand exceeds this by chance.
    assert np.all(np.abs(spread.values - expected) < 4.0 * np.hypot(*spread.errors[:2]))
    assert json.loads(json.dumps(found.documents[0], allow_nan=False))


def test_nothing_is_done_again(found: mr.ManyDampers, lot: Path, results: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (results / "dampers").iterdir()}
    again = mr.identify_many(lot, folder=results, **options(lot))
    assert again.kept == len(again.documents) == len(found.documents)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert again.table == found.table


def test_only_the_damper_whose_files_have_changed_is_done_again(
    found: mr.ManyDampers, lot: Path, tmp_path: Path
) -> None:
    other = tmp_path / "lot"
    shutil.copytree(lot / "D5", other / "D5")
    shutil.copytree(lot / "D6", other / "D6")
    heard: list[str] = []
    for _ in range(2):
        with ThreadPoolExecutor(1) as executor:
            mr.identify_many(
                other,
                folder=tmp_path / "results",
                executor=executor,
                report=lambda done, count, document: heard.append(document["damper"]),
                **options(lot),
            )
        record(other / "D5" / "1A.csv", 1.1, 1.0, 0)
    assert heard == ["D5", "D6", "D5"]


def test_results_of_other_options_are_not_mixed_with_these(
    found: mr.ManyDampers, lot: Path, results: Path
) -> None:
    with pytest.raises(ValueError, match="with a different method: choose another folder"):
        mr.identify_many(lot, folder=results, **{**options(lot), "method": "nelder_mead"})


def test_the_program_writes_table_and_report_and_says_what_was_left_out(
    found: mr.ManyDampers, lot: Path, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--columns", COLUMNS, "--period", "0.002", "--method", "least_squares"]
    code = identify_many.main([str(lot), "--output", str(results), *given])
    assert code == identify_many.LEFT_OUT
    said = capsys.readouterr().out
    assert "6 of 7 dampers identified, 7 of them in an earlier call" in said
    assert "outlier: D4" in said
    assert "broken.csv" in said
    with (results / "dampers.csv").open(newline="") as file:
        assert [row["damper"] for row in csv.DictReader(file)] == [*STRENGTHS, "D7"]
    page = (results / "population.html").read_text()
    assert page.count("<section") == 5
    assert "D4" in page
    assert "broken.csv" in page


@pytest.mark.parametrize(
    ("names", "headline"),
    [
        ({*STRENGTHS, "D7"}, "0 files were not used, and 1 dampers were not identified"),
        ({*STRENGTHS}, "everything was used"),
        ({"D7"}, "no damper was identified"),
    ],
)
def test_the_report_says_whether_everything_was_used(
    found: mr.ManyDampers, tmp_path: Path, names: set[str], headline: str
) -> None:
    documents = tuple({**d, "left_out": []} for d in found.documents if d["damper"] in names)
    whole = replace(found, documents=documents, unnamed=())
    assert headline in write_population_report(whole, tmp_path).read_text()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "there is nothing to identify"),
        (["nowhere"], "there is no nowhere"),
        (["--list", "none.csv"], "none.csv"),
        (["nowhere", "--columns", "time:x"], "'x' is not a known unit of time"),
    ],
)
def test_a_wrong_call_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert identify_many.main([*arguments, "--output", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert len(said.strip().splitlines()) == 1


def test_numbers_of_numpy_are_options(tmp_path: Path) -> None:
    listed = tmp_path / "list.csv"
    listed.write_text("path, damper\nmissing.csv, A\n")
    more = {"accept_doubtful": np.bool_(True), "current": np.float32(0.5), "workers": np.int64(1)}
    found = mr.identify_many(
        listed=listed, folder=tmp_path, columns="displacement:mm,force:N", seed=np.int64(1), **more
    )
    assert list(found.failures) == ["A"]


def test_what_is_missing_for_an_option_is_said_before_the_work(
    lot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("mr_damper_ros.lots.report.find_spec", lambda name: None)
    given = [str(lot), "--columns", COLUMNS, "--output", str(tmp_path / "out"), "--parquet"]
    assert identify_many.main(given) == 2
    assert "needs pyarrow" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_scheduler_needs_dask(
    lot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    given = [str(lot), "--columns", COLUMNS, "--output", str(tmp_path), "--scheduler", "tcp://x:1"]
    assert identify_many.main(given) == 2
    assert "Dask is not installed: pip install" in capsys.readouterr().err


def test_a_cluster_of_dask_does_the_same(found: mr.ManyDampers, lot: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    )
    with cluster:
        other = mr.identify_many(
            lot, folder=tmp_path, scheduler=cluster.scheduler_address, **options(lot)
        )
    left = ("duration_s",)
    for one, two in zip(found.table, other.table, strict=True):
        assert {k: v for k, v in one.items() if k not in left} == {
            k: v for k, v in two.items() if k not in left
        }


def test_a_folder_in_use_is_left_alone(lot: Path, tmp_path: Path) -> None:
    from mr_damper_ros.processes.files import FolderLock

    lock = FolderLock(tmp_path / ".lock")
    try:
        with pytest.raises(ValueError, match="is in use by another program"):
            mr.identify_many(lot, folder=tmp_path, **options(lot))
    finally:
        lock.release()


def population(factors: np.ndarray, error: float = 0.0) -> Population:
    """Dampers with these relative forces, known to this relative error."""
    place = known.SIGMOID.places(["f0"])[0]
    dampers = []
    for number, factor in enumerate(factors):
        values = scaled(known.PLAUSIBLE, factor)
        covariance = np.zeros((values.size, values.size))
        covariance[place, place] = (error * values[place]) ** 2
        found = ParameterSet(values, peak_velocity_range=(0.05, 0.2), current_range=(0.0, 1.5))
        dampers.append(KnownDamper(f"D{number}", found, covariance, 0.05))
    return Population(dampers)


LOT = 1.0 + 0.03 * np.random.default_rng(1).standard_normal(60)


def test_the_spread_of_a_lot_is_found() -> None:
    spread = population(LOT).forces[0]
    # With so many dampers the standard deviation is accurate to 9 %, the robust one to 15 %.
    assert spread.deviation / spread.median == pytest.approx(0.03, rel=0.3)


def test_the_force_error_follows_from_the_covariance() -> None:
    damper = population(np.ones(1), error=0.01).dampers[0]
    force, error = damper.peak_forces([(0.1, 1.0)])
    # The force is proportional to the parameter f0.
    assert error / force == pytest.approx(0.01, rel=1e-6)
