"""The Python interface for a user with recordings and without ROS."""

import math
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fresh_python import alone

import mr_damper_ros as mr
from mr_damper_ros.api import identification
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_NAMES

ROOT = Path(__file__).parents[2]
ONE_RUN = ROOT / "bags" / "5.0mm_1Hz_1.5A"
ANOTHER = ROOT / "bags" / "5.0mm_1Hz_0.5A"
RUN = mr.read_bag(ONE_RUN)[0]
SHORT = {name: getattr(RUN, name)[:12] for name in ("displacement", "force", "current")}


@pytest.fixture(scope="module")
def result() -> mr.Identification:
    return mr.identify(ONE_RUN, method="least_squares")


# -- importing -----------------------------------------------------------------------------------


def test_importing_loads_nothing_heavy() -> None:
    heavy = ("numpy", "scipy", "matplotlib", "rosbags", "yaml", "rclpy")
    said = alone(f"import mr_damper_ros\nprint([m for m in {heavy} if m in sys.modules])")
    assert said.strip() == "[]"


def test_using_every_name_changes_no_environment_variable_and_needs_no_ros() -> None:
    said = alone(
        "import os\n"
        "before = dict(os.environ)\n"
        "import mr_damper_ros as mr\n"
        "for name in mr.__all__: getattr(mr, name)\n"
        "print(dict(os.environ) == before, 'rclpy' in sys.modules)"
    )
    assert said.split() == ["True", "False"]


def test_a_source_that_is_not_installed_says_so_instead_of_a_version(tmp_path: Path) -> None:
    (tmp_path / "mr_damper_ros").symlink_to(ROOT / "mr_damper_ros")
    command = [sys.executable, "-S", "-m", "mr_damper_ros", "--version"]
    there = {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=there, capture_output=True, check=False)
    assert (done.returncode, b"not installed" in done.stdout) == (0, True)


def test_all_names_are_listed_and_no_other_is_made_up() -> None:
    assert set(mr.__all__) <= set(dir(mr))
    with pytest.raises(AttributeError, match="has no attribute 'identfy'"):
        mr.identfy  # type: ignore[attr-defined]  # noqa: B018


# -- accepted input ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ([str(ONE_RUN)], {}),
        ([RUN], {}),
        ([[RUN]], {}),
        (
            [],
            {
                "displacement": RUN.displacement.tolist(),
                "force": RUN.force.tolist(),
                "current": 1.5,
                "period": RUN.period,
            },
        ),
    ],
    ids=["path", "recording", "list", "arrays"],
)
def test_paths_recordings_and_arrays_give_the_same_set(
    result: mr.Identification, given: list[Any], named: dict[str, Any]
) -> None:
    found = mr.identify(*given, method="least_squares", **named)
    assert found.parameter_set.as_dict() == pytest.approx(result.parameter_set.as_dict())


@pytest.mark.parametrize(
    ("given", "named", "sentence"),
    [
        ([], {}, "there are no runs"),
        ([RUN.displacement], {}, "cannot be of type ndarray"),
        ([b"run"], {}, "cannot be of type bytes"),
        ([], {"displacement": [1.0, 2.0]}, "force and current and period missing"),
        ([ROOT / "doc" / "example.csv"], {}, "not a bag: describe its columns and units"),
        (["nowhere"], {}, "no bag at nowhere"),
        ([RUN], {"model": "bouc-wen"}, "model 'bouc-wen' is unknown"),
        ([RUN], {"method": "guess"}, "method 'guess' is unknown"),
        ([RUN], {"method": "least_squares", "profile": "alfa"}, "no parameter 'alfa'"),
        (
            [],
            {"displacement": np.arange(50.0), "force": [1.0], "current": 0.0, "period": 1.0},
            "50 displacements but 1 values of force",
        ),
        ([RUN], {"start": mr.ParameterSet(np.full(16, 1e308))}, "the start of f0 is 1e.308"),
        ([RUN], {"start": {}}, "set cannot be of type dict: give a ParameterSet"),
        ([replace(RUN, **SHORT)], {}, f"{RUN.name}: a window needs at least 16 samples"),
        ([], {**SHORT, "period": "1 ms"}, "period is '1 ms': give the sample period"),
        ([], {**SHORT, "force": 1j * SHORT["force"], "period": 1e-3}, "complex numbers"),
        ([RUN], {"mass": "2 kg"}, "the mass is '2 kg': give a number of kilograms"),
        ([RUN], {"mass": 1e306}, "kilograms up to 1e.06, or 0"),
        ([RUN], {"starts": 1.0}, "starts is 1.0: give a whole number of at least 1"),
        ([RUN], {"workers": "3"}, "workers is '3': give a whole number of at least 1"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(
    given: list[Any], named: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence) as caught:
        mr.identify(*given, **named)
    assert len(str(caught.value).splitlines()) == 1


# -- results -------------------------------------------------------------------------------------


def test_the_result_tells_coefficients_and_parameters_with_their_errors(
    result: mr.Identification,
) -> None:
    assert result.parameters["f0"].observable
    # One run determines the yield force, but not the contribution of f0 to it.
    assert result.coefficients["f_t"].standard_error > 0.0
    assert result.parameters["f0"].only_with
    assert math.isnan(result.parameters["f0"].standard_error)
    assert result.parameters["k2"].unit == "1"
    assert not result.parameters["k2"].observable
    assert math.isnan(result.parameters["k2"].standard_error)
    assert tuple(result.coefficients) == COEFFICIENT_NAMES
    shown = str(result)
    assert shown.index("yield force") < shown.index("not observable")
    assert shown.index("f_t") < shown.index("f0")
    odd = replace(RUN, name="<b>run</b>")
    page = mr.validate(result.parameter_set, odd)._repr_html_()
    assert "&lt;b&gt;run" in page
    assert ">f_t</td>" in result._repr_html_()
    inside, outside = mr.validate(result.parameter_set, ONE_RUN, ANOTHER).runs
    assert inside.remark == ""
    assert outside.remark == "OUT OF RANGE: current 0.5 A, but the set holds for 1.5 A"


def test_the_file_is_not_more_certain_than_the_table(result: mr.Identification) -> None:
    stored = yaml.safe_load(result.parameter_set.to_yaml())["parameters"]
    document = result.document()
    for name, entry in result.parameters.items():
        error = None if math.isnan(entry.standard_error) else entry.standard_error
        assert stored[name]["standard_error"] == document["standard_errors"][name] == error
        assert stored[name]["observable"] is document["observable"][name] is entry.observable
    assert stored["f0"] | {"value": 0.0} == {
        "value": 0.0,
        "unit": "N",
        "standard_error": None,
        "discrepancy": None,
        "observable": True,
    }


def test_terminal_file_and_document_tell_one_nrmse(
    result: mr.Identification, tmp_path: Path
) -> None:
    result.save(tmp_path / "set.yaml")
    in_file = yaml.safe_load((tmp_path / "set.yaml").read_text())["nrmse"]
    assert in_file == pytest.approx(result.nrmse)
    assert result.document()["metrics"]["nrmse"] == pytest.approx(result.nrmse)
    assert f" {result.nrmse:.2%} " in str(result)
    again = mr.validate(tmp_path / "set.yaml", ONE_RUN)
    assert again.nrmse == pytest.approx(result.nrmse)
    file = tmp_path / "folder" / "set.yaml"
    result.parameter_set.save(file)
    assert mr.ParameterSet.load(file).to_yaml() == result.parameter_set.to_yaml()
    for takes in (mr.ForcePredictor().set_parameters, partial(mr.WindowTracker, None)):
        with pytest.raises(ValueError, match=r"parameter_set of an Identification"):
            takes(str(file))


def test_the_law_that_the_runs_support_can_be_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    assert mr.choose_law(RUN, models="bingham").chosen.model == "bingham"
    two = partial(identification.cross_validate, models=("bingham", "hyperbolic_tangent"))
    monkeypatch.setattr(identification, "cross_validate", two)
    found = mr.identify(RUN, model="auto")
    assert found.parameter_set.model == found.choice.chosen.model
    assert str(found).startswith("NRMSE on segments that were left out")


def test_a_stopped_comparison_of_laws_identifies_none(monkeypatch: pytest.MonkeyPatch) -> None:
    # A law that is compared within the pause between two reports could not be stopped.
    monkeypatch.setattr("mr_damper_ros.estimation.differential_evolution.LONGEST_PAUSE", 0.0)
    two = partial(identification.cross_validate, models=("bingham", "hyperbolic_tangent"))
    monkeypatch.setattr(identification, "cross_validate", two)
    with pytest.raises(ValueError, match=r"stopped before hyperbolic_tangent \(NRMSE on segments"):
        mr.identify(RUN, model="auto", report=lambda news: "hyperbolic" not in news.stage)


# -- parameter files and the other laws ----------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "sentence"),
    [(b"\xff\xfe\x00", "not text"), (b"parameters: {f0: 1}", "is missing")],
    ids=["bytes", "half a set"],
)
def test_a_file_that_is_no_set_is_named(tmp_path: Path, content: bytes, sentence: str) -> None:
    file = tmp_path / "set.yaml"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=sentence) as caught:
        mr.ParameterSet.load(file)
    assert str(file) in str(caught.value)


def test_a_run_that_does_not_fit_to_the_others_is_named() -> None:
    odd = replace(RUN, name="the odd one", force=0.6 * RUN.force)
    found = mr.identify([*[RUN] * 9, odd], method="least_squares")
    assert found.nrmse < 0.3
    assert not found.success
    assert "the odd one: the set explains too little of the force" in found.message
