"""Parameter sets: exact conversion to text and back, and one clear sentence for every fault."""

import dataclasses
import math
from typing import Any

import known
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, motion_window
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.signals.blocks import STAMP_LIMIT

FINITE = st.floats(allow_nan=False, allow_infinity=False)
NUMBER = st.floats(allow_nan=False)
PRINTABLE = st.text(st.characters().filter(str.isprintable), max_size=200)


def ordered_pair() -> st.SearchStrategy[tuple[float, float]]:
    return st.tuples(NUMBER, NUMBER).map(lambda pair: (min(pair), max(pair)))


@st.composite
def parameter_sets(draw: st.DrawFn) -> ParameterSet:
    model = draw(st.sampled_from(list(MODELS.values())))
    count = len(model.parameters)

    def one_for_each(entries: st.SearchStrategy[Any]) -> np.ndarray:
        return np.array(draw(st.lists(entries, min_size=count, max_size=count)))

    return ParameterSet(
        model=model.name,
        values=np.clip(one_for_each(FINITE), *model.bounds),
        standard_errors=one_for_each(st.floats(0.0)),
        observable=one_for_each(st.booleans()),
        set_id=draw(PRINTABLE),
        source=draw(PRINTABLE),
        peak_velocity_range=draw(ordered_pair()),
        current_range=draw(ordered_pair()),
        nrmse=draw(st.one_of(st.floats(0.0), st.just(math.nan))),
        stamp_ns=draw(st.integers(-STAMP_LIMIT, STAMP_LIMIT - 1)),
        largest_force=draw(st.one_of(FINITE.map(abs), st.just(math.nan))),
        discrepancies=one_for_each(st.one_of(st.floats(0.0), st.just(math.nan))),
        dependence_range=draw(st.one_of(st.none(), ordered_pair())),
    )


@pytest.mark.parametrize("given", [[0, 1], np.array([0.0, 1.0]), np.array([0, 1], np.float32)])
def test_a_range_of_numpy_is_a_range(given: Any) -> None:
    chosen = ParameterSet(LITERATURE, current_range=given, peak_velocity_range=given)
    assert chosen.current_range == chosen.peak_velocity_range == (0.0, 1.0)
    for wrong in (None, 1.0, (0, 1, 2)):
        with pytest.raises(ParameterError, match="printable characters"):
            ParameterSet(LITERATURE, set_id=wrong)  # type: ignore[arg-type]
        with pytest.raises(ParameterError, match="a list of two numbers"):
            ParameterSet(LITERATURE, current_range=wrong)


@known.fixed(25)
@given(parameter_sets())
def test_text_and_back_is_exact(original: ParameterSet) -> None:
    read = ParameterSet.from_yaml(original.to_yaml())
    for field in dataclasses.fields(ParameterSet):
        np.testing.assert_array_equal(
            getattr(read, field.name), getattr(original, field.name), err_msg=field.name
        )


def by_hand(**changes: object) -> str:
    """A file written by hand: sixteen numbers and these top-level entries."""
    document: dict[str, object] = {"parameters": dict(zip(PARAMETER_NAMES, range(16), strict=True))}
    document.update(changes)
    return yaml.safe_dump(document)


def with_parameter(name: str, entry: object) -> str:
    parameters: dict[str, object] = dict(zip(PARAMETER_NAMES, range(16), strict=True))
    parameters[name] = entry
    return by_hand(parameters=parameters)


def without_parameter(name: str) -> str:
    document = yaml.safe_load(by_hand())
    del document["parameters"][name]
    return yaml.safe_dump(document)


def test_sixteen_plain_numbers_are_enough() -> None:
    read = ParameterSet.from_yaml(by_hand())
    assert read.values.tolist() == list(range(16))
    assert not read.observable.any()
    assert read.source == "file"


FAULTS = {
    "not yaml": ("parameters: [1, 2\nfoo: {", r"not valid YAML at line \d"),
    "code": ("!!python/object/apply:os.getcwd []", "not valid YAML at line 1"),
    "empty": ("", "no mapping 'parameters': give the values"),
    "parameters as list": (by_hand(parameters=[1, 2]), "'parameters' must map the names"),
    "stray entry": (by_hand(comment="x"), "unknown entries comment: remove them"),
    "unknown model": (by_hand(model="magic"), "model 'magic' is unknown: the models are bingham, "),
    "list of models": (by_hand(model=["sigmoid"]), r"model \['sigmoid'\] is unknown"),
    "names of another model": (by_hand(model="bingham"), "model 'bingham' has no parameter I0, "),
    "unknown parameter": (
        with_parameter("f1", 3.0),
        "model 'sigmoid' has no parameter f1: the names are f0, I0",
    ),
    "missing parameter": (without_parameter("k6"), "parameter k6 is missing: give its value"),
    "no value": (with_parameter("k6", {"unit": "1"}), "parameter k6 is None: give a number"),
    "truth": (with_parameter("k6", True), "parameter k6 is True: give a number"),
    "nan": (with_parameter("k6", math.nan), "parameter k6 is nan: give a finite number"),
    "infinite": (with_parameter("k6", -math.inf), "parameter k6 is -inf: give a finite number"),
    "stray in parameter": (
        with_parameter("k6", {"value": 1.0, "min": 0.0}),
        "parameter k6 has unknown entries min: remove them",
    ),
    "wrong unit": (
        with_parameter("f0", {"value": 1.0, "unit": "kN"}),
        "parameter f0 is given in kN: convert it to N",
    ),
    "error as text": (
        with_parameter("k6", {"value": 1.0, "standard_error": "small"}),
        "standard error of k6 is 'small': give a number",
    ),
    "stamp with a point": (by_hand(stamp_ns=1.5), "stamp_ns must be a whole number of nanoseconds"),
    "stamp as truth": (by_hand(stamp_ns=True), "stamp_ns must be a whole number of nanoseconds"),
    "range of three": (
        by_hand(current_range=[0.0, 1.0, 2.0]),
        "current_range must be a list of two numbers, lower bound first",
    ),
    "reversed range": (
        by_hand(peak_velocity_range=[0.3, 0.1]),
        r"peak_velocity_range is \[0.3, 0.1\]: give the lower bound first",
    ),
    "range of nan": (by_hand(current_range=[math.nan, 1.0]), "give the lower bound first"),
    "negative force": (
        by_hand(largest_force=-1.0),
        "largest_force is -1.0: give a finite, non-negative force",
    ),
    "half a surrogate pair": (by_hand() + 'id: "\\ud800"\n', r"the id .* is '\\ud800': give"),
    "a surrogate as a key": (by_hand() + '"\\ud800": 1\n', r"unknown entries \\ud800: remove"),
    "an id of two lines": (by_hand(id="a\nb"), "the id of .* printable characters"),
    "an endless source": (by_hand(source="a" * 201), "give at most 200 printable characters"),
    "a stamp after 2038": (by_hand(stamp_ns=STAMP_LIMIT), "which a stamp cannot hold"),
    "a number of 5000 digits": (
        f"stamp_ns: 0x{'f' * 5000}\n{by_hand()}",
        "which a stamp cannot hold",
    ),
    "a flag of 5000 digits": (
        by_hand().replace("k6: 15", f"k6: {{value: 1.0, observable: 0x{'f' * 5000}}}"),
        "an entry that cannot be used",
    ),
    "an integer beyond floating point": (with_parameter("k6", 10**400), "k6"),
    "observable as text": (with_parameter("k6", {"value": 1.0, "observable": "no way"}), "k6"),
    "a negative standard error": (with_parameter("k6", {"value": 1.0, "standard_error": -2}), "k6"),
    "a negative discrepancy": (with_parameter("k6", {"value": 1.0, "discrepancy": -2}), "k6"),
    "a name given twice": (by_hand().replace("  a0: 3\n", "  a0: 3\n  a0: 4\n"), "a0"),
}


@pytest.mark.parametrize(("text", "sentence"), FAULTS.values(), ids=FAULTS.keys())
def test_a_fault_in_the_file_is_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence) as caught:
        ParameterSet.from_yaml(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_value_out_of_its_bounds_is_refused(share: float) -> None:
    values = known.EXAMPLES["bouc_wen"].copy()
    values[MODELS["bouc_wen"].parameter_names.index("share")] = share
    with pytest.raises(ParameterError, match=f"parameter share is {share}: it must lie in 0 to 1"):
        ParameterSet(values, model="bouc_wen")


@pytest.mark.parametrize("name", ["values", "standard_errors", "observable", "discrepancies"])
def test_a_wrong_number_of_values_is_refused(name: str) -> None:
    arrays = {"values": LITERATURE, name: np.ones(15)}
    with pytest.raises(ParameterError, match=rf"{name} of .* must hold 16 numbers.*\(15,\)"):
        ParameterSet(**arrays)


def test_the_arrays_of_a_set_are_its_own_and_cannot_be_changed() -> None:
    values = LITERATURE.copy()
    made = ParameterSet(values)
    values[0] = -1.0
    assert made.values[0] == LITERATURE[0]
    with pytest.raises(ValueError, match="read-only"):
        made.values[0] = -1.0


def test_a_set_of_another_model_than_needed_is_refused() -> None:
    extended = ParameterSet(np.zeros(19), model="sigmoid_lag")
    assert extended.of_model("sigmoid_lag") is extended
    with pytest.raises(ParameterError, match=r"belong to model 'sigmoid_lag': give .* 'sigmoid'"):
        extended.of_model("sigmoid")


@pytest.mark.parametrize(
    "text",
    ["[" * 5_000, "a: 2001-02-31", "a: !!int ''", "a: !!timestamp x", "a: !!float ''", "? {a: 1}"],
)
def test_whatever_yaml_stumbles_over_is_one_error(text: str) -> None:
    with pytest.raises(ParameterError, match="YAML"):
        ParameterSet.from_yaml(text)


@pytest.mark.parametrize(
    ("time", "current", "sentence"),
    [
        ([0.0, 1e-3, 2.03e-3], 1.0, "give uniform samples"),
        ([0.0, 1.0], 1.0, "one displacement for each"),
        ([0.0, 1.0, 2.0], [1.0, 1.0], "one current for each"),
        (np.arange(3).astype("datetime64[s]"), 1.0, "the times are dates: give seconds"),
        (np.ma.masked_array([0.0, 1.0, 2.0], [False, True, False]), 1.0, "nan s apart"),
    ],
)
def test_times_that_do_not_fit_are_refused(time: Any, current: Any, sentence: str) -> None:
    found = ParameterSet(MODELS["sigmoid"].initial_values()[0])
    with pytest.raises(ValueError, match=sentence):
        found.force(time, [0.0, 1e-3, 0.0], current)


def test_noise_of_the_acceleration_flips_no_branch() -> None:
    time = 1e-2 * np.arange(3000)
    phases = 2.0 * np.pi * np.random.default_rng(0).random(30)
    rates = 2.0 * np.pi * np.linspace(0.4, 3.0, 30)
    clean = 2e-3 * np.sin(np.outer(time, rates) + phases).sum(axis=1)
    noisy = clean + 2e-4 * np.random.default_rng(1).standard_normal(time.size)
    known_set = ParameterSet(LITERATURE)
    force = known_set.force(time, noisy, 1.0)
    jumping = known_set.window_force(motion_window(time, noisy, 1.0), gradual=False)
    assert np.abs(np.diff(force)).max() < 0.8 * np.abs(np.diff(jumping)).max()
