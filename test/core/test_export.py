"""Exported code computes the law, both for single points and along a stream."""

import ctypes
import itertools
import math
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fresh_python import said
from known import EXAMPLES, PLAUSIBLE, index, rms
from random_motion import BandLimitedRandom

from mr_damper_ros.control.export.exported_law import ExportedLaw, ExportSettings, Vectors
from mr_damper_ros.control.export.fmu import compile_library, compiler
from mr_damper_ros.control.export.source_code import C, M, functions, header
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.observer import CausalDifferentiator
from mr_damper_ros.kinematics.peak_velocity import MEMORY, PeakVelocity
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.formulas import assignments
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import CONDITIONS, parameters
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tools import export

POINTS = 5000

SAME = 1e-9
"""Relative to the force, or to 1 N if the force is smaller."""

LATE = np.array([*PLAUSIBLE, 3e-8, 2000.0, -40.0, 0.008])

SETS = {
    "sigmoid": ParameterSet(PLAUSIBLE, peak_velocity_range=(0.0, 1.0)),
    "thesis": ParameterSet(parameters(CONDITIONS[20])),
    "sigmoid_lag": ParameterSet(LATE, model="sigmoid_lag", peak_velocity_range=(0.02, 0.3)),
    # Its steepness has a pole at 0.08 m/s.
    "pole": ParameterSet(
        np.where(np.arange(16) == index("k0"), -12.5, PLAUSIBLE), peak_velocity_range=(0.02, 0.06)
    ),
}


class Compiled:
    """The C code of a set, called for many points at once."""

    def __init__(self, law: ExportedLaw, folder: Path) -> None:
        (folder / "mr_damper.h").write_text(header(law, "mr_damper"))
        driver = Path(__file__).with_name("export_driver.c")
        self.said = compile_library(driver, folder / "driver.so", f"-I{folder}")
        self._library = ctypes.CDLL(str(folder / "driver.so"))

    def law(self, inputs: Array) -> tuple[Array, Array]:
        coefficients, force = np.empty((len(inputs), 7)), np.empty(len(inputs))
        self._library.law(_of(inputs), len(inputs), _of(coefficients), _of(force))
        return coefficients.T, force

    def inverse(self, inputs: Array, wanted: Array) -> tuple[Array, Array]:
        current, force = np.empty(wanted.size), np.empty(wanted.size)
        self._library.inverse(_of(inputs), _of(wanted), wanted.size, _of(current), _of(force))
        return current, force

    def stream(self, displacement: Array, current: Array, centre: float) -> Array:
        force = np.empty(displacement.size)
        self._library.stream(
            *(_of(displacement), _of(current), force.size, ctypes.c_double(centre), _of(force))
        )
        return force


def _of(array: Array) -> Any:
    assert array.flags.c_contiguous
    return array.ctypes.data_as(ctypes.c_void_p)


@pytest.fixture(scope="module", params=["thesis", "sigmoid_lag", "pole"])
def law(request: pytest.FixtureRequest) -> ExportedLaw:
    return ExportedLaw(SETS[request.param], ExportSettings())


@pytest.fixture(scope="module")
def compiled(law: ExportedLaw, tmp_path_factory: pytest.TempPathFactory) -> Compiled:
    if compiler() is None:
        pytest.skip("there is no C compiler to make the exported code with")
    return Compiled(law, tmp_path_factory.mktemp("c"))


def assert_same(got: Array, expected: Array) -> None:
    np.testing.assert_array_less(np.abs(got - expected), SAME * np.maximum(np.abs(expected), 1.0))


# -- C ---------------------------------------------------------------------------------------------


def test_the_header_compiles_as_cpp_without_a_warning(law: ExportedLaw, tmp_path: Path) -> None:
    if (found := shutil.which("c++")) is None:
        pytest.skip("there is no C++ compiler")
    (tmp_path / "mr_damper.h").write_text(header(law, "mr_damper"))
    (tmp_path / "used.cpp").write_text('#include "mr_damper.h"\n')
    flags = ("-std=c++11", "-fsyntax-only", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
    done = subprocess.run(
        [found, *flags, str(tmp_path / "used.cpp")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_c_code_is_that_of_the_package(law: ExportedLaw, compiled: Compiled) -> None:
    vectors = Vectors.of(law, POINTS)
    coefficients, force = compiled.law(vectors.inputs)
    assert_same(coefficients, vectors.coefficients)
    assert_same(force, vectors.force)
    inputs, wanted = wanted_forces(law, 1000)
    assert_gives(law, inputs, wanted, compiled.inverse(inputs, wanted)[0])
    time = np.arange(2500) * law.settings.period
    displacement = 0.02 + BandLimitedRandom(0.004, 0.5, 6.0, seed=2).at(time).displacement
    current = np.where(np.sin(7.0 * time) > 0.3, 1.2, 0.2)
    got = compiled.stream(displacement, current, 0.02)
    expected = expected_stream(law, displacement, current, 0.02)
    # Of the largest force: rounding in the observer, amplified by its gain.
    assert np.abs(got - expected).max() <= 1e-7 * np.abs(expected).max()
    # A wrong sample counts as its predecessor.
    wrong, others = np.array([0, 1200, 1201, 1900]), np.array([0, 1199, 1199, 1899])
    held, held_current = displacement.copy(), current.copy()
    held[wrong], held_current[wrong] = displacement[others], current[others]
    held[0], held_current[0] = 0.02, 0.0
    displacement[wrong], current[wrong] = [math.nan, math.inf, -math.inf, math.nan], math.nan
    got = compiled.stream(displacement, current, 0.02)
    np.testing.assert_array_equal(got, compiled.stream(held, held_current, 0.02))


def test_the_c_code_holds_the_law_beyond_its_range(law: ExportedLaw, compiled: Compiled) -> None:
    inputs = Vectors.of(law, POINTS).inputs
    held = inputs.copy()
    held[:, 1] = held[:, 1].clip(*law.parameters.peak_velocity_range)
    assert np.any(held[:, 1] != inputs[:, 1]) or law.parameters is SETS["thesis"]
    for got, expected in zip(compiled.law(inputs), compiled.law(held), strict=True):
        np.testing.assert_array_equal(got, expected)


def wanted_forces(law: ExportedLaw, count: int) -> tuple[Array, Array]:
    """About ``count`` inputs (n, 5) and desired forces [N] (n,), some of them not attainable."""
    inputs = Vectors.of(law, count, seed=1).inputs
    inputs = np.ascontiguousarray(inputs[np.abs(inputs[:, 0]) < 1.0])
    least, most = attainable(law, inputs)
    further = 0.3 * (most - least)
    return inputs, np.random.default_rng(2).uniform(least - further, most + further)


def attainable(law: ExportedLaw, inputs: Array) -> tuple[Array, Array]:
    """Smallest and largest force [N] (n,) over the current."""
    every = np.linspace(law.nodes[0], law.nodes[-1], 201)
    forces = np.stack([law.expected(_at(inputs, i))[1] for i in every])
    return forces.min(axis=0), forces.max(axis=0)


def assert_gives(law: ExportedLaw, inputs: Array, wanted: Array, current: Array) -> None:
    """Assert that the currents (n,) give the desired forces, or the nearest ones."""
    least, most = attainable(law, inputs)
    assert current.min() >= law.nodes[0]
    assert current.max() <= law.nodes[-1]
    force = law.expected(_at(inputs, current))[1]
    further = np.abs(force - wanted) - np.abs(np.clip(wanted, least, most) - wanted)
    size = np.maximum(np.maximum(np.abs(least), np.abs(most)), 1.0)
    if law.parameters.model == "sigmoid":  # the force of the other law has a lag and an offset
        # Of the span: the tolerance of the inverse, and its rounding.
        assert np.all(further <= 1.1e-6 * (most - least) + SAME * size)


def _at(inputs: Array, current: Array | float) -> Array:
    other = inputs.copy()
    other[:, 2] = current
    return other


def expected_stream(law: ExportedLaw, displacement: Array, current: Array, centre: float) -> Array:
    """Force of the stream, computed by the classes of this package."""
    period = law.settings.period
    observer = CausalDifferentiator(period, law.settings.bandwidth)
    peak = PeakVelocity(period, MEMORY)
    state, forces = None, []
    for place in range(displacement.size):
        here = slice(place, place + 1)
        u, v, a = observer.follow(displacement[here])
        v_m = peak.follow(v, a) if observer.settled_count > 0 else np.abs(v)
        motion = Motion(u - centre, v, a, v_m, None)
        found, state = law.parameters.follow(motion, current[here], period, state, gradual=True)
        forces.append(found)
    return np.concatenate(forces)


# -- M-code ----------------------------------------------------------------------------------------


def test_the_m_code_is_the_law_point_by_point(law: ExportedLaw) -> None:
    """Its formulas contain only operators and functions that Python has too."""
    vectors = Vectors.of(law, 2000)
    names: dict[str, Any] = {
        "exp": np.exp,
        "tanh": np.tanh,
        "abs": np.abs,
        "damper_larger": np.maximum,
        "damper_clip": np.clip,
        "damper_where": np.where,
        "damper_sat": lambda x: np.clip(x, -1e100, 1e100),
        "damper_number": lambda x: np.where(np.isnan(x), 0.0, x),
        **dict(zip(("v", "v_m", "i", "s", "change"), vectors.inputs.T, strict=True)),
    }
    body = functions(law)["damper_force.m"].splitlines()
    first = next(k for k, line in enumerate(body) if line.startswith("f0 ="))
    with np.errstate(all="ignore"):
        for line in body[first:-1]:
            exec(line.replace(".*", "*").replace("./", "/").rstrip(";"), {}, names)
    assert_same(names["force"], vectors.force)


needs_octave = pytest.mark.skipif(
    shutil.which("octave") is None, reason="Octave is not installed: apt install octave"
)


def octave(law: ExportedLaw, folder: Path, script: str) -> Array:
    """Numbers that a script prints when it is run with the M-code of a law."""
    for name, text in functions(law).items():
        (folder / name).write_text(text)
    printed = said("octave", "--no-gui", "--quiet", "--eval", script, cwd=folder)
    return np.array(printed.split(), dtype=float)


@needs_octave
def test_octave_finds_the_m_code_to_be_the_law(law: ExportedLaw, tmp_path: Path) -> None:
    (tmp_path / "vectors.csv").write_text(Vectors.of(law, POINTS).csv())
    (worst,) = octave(law, tmp_path, "printf('%.17g ', damper_check('vectors.csv'));")
    assert worst < SAME


# -- FMU -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if compiler() is None:
        pytest.skip("there is no C compiler to make the exported code with")
    folder = tmp_path_factory.mktemp("fmu")
    SETS["sigmoid_lag"].save(folder / "set.yaml")
    arguments = [str(folder / "set.yaml"), "--format", "fmu", "--output", str(folder)]
    assert export.main(arguments) == 0
    return folder / "mr_damper.fmu"


STEPS = {"0.3 ms": 3e-4, "1 ms": 1e-3, "3 ms": 3e-3, "10 ms": 1e-2, "varying": None}
"""Communication steps [s]; the period of the damper is 1 ms."""

FOLLOWED = 0.03
"""Largest RMS error of the FMU's force, relative to the standard deviation of the force."""


def simulated(fmu: Path, step: float | None, frequency: float) -> tuple[Array, Array, list[str]]:
    """Force and coil current [A] (n, 2) after each communication step of a sine of 5 mm at 0.7 A.

    Also the force [N] (n,) of the law at these times, and the messages of the FMU. Without a step,
    it varies from 0.3 to 10 ms.
    """
    fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: pip install fmpy")
    from fmpy.fmi2 import FMU2Slave, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE

    duration, fine = 1.5, np.arange(1501) * 1e-3
    steps = np.random.default_rng(0).uniform(3e-4, 1e-2, 1000) if step is None else [step] * 5000
    times = np.concatenate(([0.0], np.cumsum(steps)))
    times = times[times <= duration + 1e-9]

    def moved(time: Array) -> Array:
        return np.asarray(5e-3 * np.sin(2.0 * np.pi * frequency * time))

    said: list[str] = []
    # The last argument is the text of the message.
    log = fmi2CallbackLoggerTYPE(lambda *each: said.append(each[-1].decode()))
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = log
    description = fmpy.read_model_description(str(fmu))
    names = {each.name: each.valueReference for each in description.modelVariables}
    folder = fmpy.extract(str(fmu))
    slave = FMU2Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="damper",
    )
    slave.instantiate(callbacks=callbacks)
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    inputs, outputs = (
        [names[each] for each in group]
        for group in (("displacement", "current"), ("force", "coil_current"))
    )
    slave.setReal(inputs, [moved(times[0]), 0.7])
    slave.exitInitializationMode()
    found = [slave.getReal(outputs)]
    for start, end in itertools.pairwise(times.tolist()):
        slave.setReal(inputs, [moved(start), 0.7])
        slave.doStep(start, end - start)
        found.append(slave.getReal(outputs))
    slave.terminate()
    slave.freeInstance()
    shutil.rmtree(folder)
    law = ExportedLaw(SETS["sigmoid_lag"], ExportSettings())
    force = expected_stream(law, moved(fine), np.full(fine.size, 0.7), 0.0)
    return np.array(found), np.interp(times, fine, force), said


def test_fmpy_finds_nothing_wrong(fmu: Path) -> None:
    validation = pytest.importorskip("fmpy.validation", reason="FMPy is missing: pip install fmpy")
    assert validation.validate_fmu(str(fmu)) == []


@pytest.mark.parametrize("step", STEPS)
def test_the_fmu_follows_the_law_at_any_communication_step(fmu: Path, step: str) -> None:
    found, expected, said = simulated(fmu, STEPS[step], frequency=2.0)
    late = slice(len(found) // 3, None)
    error = found[late, 0] - expected[late]
    assert rms(error) < FOLLOWED * np.std(expected)
    assert found[-1, 1] == pytest.approx(0.7, rel=1e-3)
    assert said == []


def test_the_fmu_warns_once_of_steps_too_long_for_the_motion(fmu: Path) -> None:
    _, _, said = simulated(fmu, 0.02, frequency=5.0)
    assert len(said) == 1
    assert "the communication step of 0.02 s is too long for the motion" in said[0]


# -- the program -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["c", "matlab"])
def test_the_program_writes_code_and_test_vectors(kind: str, tmp_path: Path) -> None:
    SETS["sigmoid"].save(tmp_path / "set.yaml")
    out = tmp_path / "code"
    arguments = [str(tmp_path / "set.yaml"), "--format", kind, "--output", str(out)]
    assert export.main(arguments) == 0
    assert len((out / "vectors.csv").read_text().splitlines()) == 1001
    assert (out / ("mr_damper.h" if kind == "c" else "damper_force.m")).is_file()


def test_a_set_of_one_current_is_exported_with_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(SETS["sigmoid"], current_range=(0.5, 0.5)).save(tmp_path / "set.yaml")
    arguments = [str(tmp_path / "set.yaml"), "--format", "c", "--output", str(tmp_path)]
    assert export.main(arguments) == 0
    assert "identified at 0.5 A only" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--bandwidth", "600"], "samples 0.001 s apart allow"),
        (["--highest-current", "0"], "not above the lowest"),
        (["--name", "2nd"], "is not a valid C name"),
        (["--period", "0"], "period must be"),
    ],
)
def test_what_cannot_be_exported_is_one_sentence(
    options: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    SETS["sigmoid"].save(tmp_path / "set.yaml")
    arguments = [str(tmp_path / "set.yaml"), "--format", "c", "--output", str(tmp_path), *options]
    assert export.main(arguments) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert len(said.strip().splitlines()) == 1


def test_other_laws_say_that_they_cannot_be_exported() -> None:
    with pytest.raises(ValueError, match="sigmoid or sigmoid_lag"):
        ExportedLaw(ParameterSet(EXAMPLES["bingham"], model="bingham"), ExportSettings())
    assert {name for name, model in MODELS.items() if model.formulas} == {"sigmoid", "sigmoid_lag"}


def test_brackets_are_kept_where_they_count() -> None:
    line = ("x", "a * (b + c) - (d - e) / f")
    assert assignments([line], M) == ["x = a .* (b + c) - (d - e) ./ f;"]
    lines = ("x", "a - (b - c)"), ("y", "-a4 * v_m")
    assert assignments(lines, C) == ["const double x = a - (b - c);", "const double y = -a4 * v_m;"]
    for wrong in ("a if b else c", "a ** b"):
        with pytest.raises(ValueError, match="is not allowed in a formula"):
            assignments([("x", wrong)], C)
