"""The parameter tables of the nodes: validation, and agreement with config/*.yaml."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import yaml

from mr_damper_ros.settings.option_table import (
    CheckedSettings,
    ParameterTable,
    build,
    describe,
    group,
    option,
    options,
)
from scripts import write_config


@dataclass(frozen=True)
class Inner(ParameterTable):
    gain: float = option(2.0, "Gain.", within=(0.0, 10.0))


@dataclass(frozen=True)
class Example(ParameterTable):
    mode: str = option("slow", "Mode.", choices=("slow", "fast"))
    count: int = option(3, "Count.", within=(1, 9))
    active: bool = option(True, "Active.")
    maybe: float = option(math.nan, "Not given.")
    inner: Inner = group(Inner)


@dataclass(frozen=True)
class Checked(CheckedSettings):
    speed: float = option(1.0, "Speed.", within=(0.0, 5.0))
    gradual: bool = option(True, "Gradual.")
    inner: Inner = group(Inner)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.speed > self.inner.gain:
            raise ValueError("speed is larger than inner.gain")


@dataclass(frozen=True)
class Derived(ParameterTable):
    checked: Checked = group(Checked, flat=True)
    name: str = option("x", "Name.", read_only=False)


OPTIONS = {item.name: item for item in options(Example)}


def test_a_table_is_built_from_values_by_full_name() -> None:
    built = build(Example, {"count": 7, "inner.gain": 1.5})
    assert (built.count, built.inner.gain, built.mode) == (7, 1.5, "slow")


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"speed": 6.0}, "speed must be from 0 to 5, not 6"),
        ({"speed": math.nan}, "speed must be a finite number"),
        ({"speed": 3.0}, "speed is larger than inner.gain"),
        ({"gradual": "no"}, "gradual must be true or false, not 'no'"),
    ],
)
def test_settings_cannot_be_made_with_values_that_are_not_allowed(
    values: dict[str, float], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        Checked(**values)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=sentence):
        build(Derived, values)


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("mode", "medium", "must be one of slow, fast"),
        ("mode", 3, "must be a text"),
        ("count", 0, "must be from 1 to 9"),
        ("count", 2.0, "must be an integer"),
        ("count", True, "must be an integer"),
        ("active", 1, "must be true or false"),
        ("inner.gain", 11.0, "must be from 0 to 10"),
        ("inner.gain", math.nan, "must be a finite number"),
        ("inner.gain", math.inf, "must be a finite number"),
        ("inner.gain", None, "must be a number"),
        ("maybe", math.inf, "must be a finite number"),
    ],
)
def test_a_bad_value_is_refused_in_a_sentence(name: str, value: Any, part: str) -> None:
    objection = OPTIONS[name].objection(value)
    assert part in objection
    assert name in objection


def test_the_description_names_every_option_and_its_limits() -> None:
    text = describe(Example)
    assert all(name in text for name in OPTIONS)
    assert "one of slow, fast" in text
    assert "from 0 to 10" in text


def test_the_committed_files_are_the_generated_ones() -> None:
    pytest.importorskip("rclpy", reason="the nodes need ROS")
    for name, text in write_config.texts().items():
        committed = (write_config.CONFIG / name).read_text(encoding="utf-8")
        assert committed == text, f"call `make config`: config/{name} is not what is generated"


@pytest.mark.parametrize("node", write_config.NODES)
def test_a_generated_file_gives_every_option_its_default(node: str) -> None:
    pytest.importorskip("rclpy", reason="the nodes need ROS")
    values = yaml.safe_load(write_config.config_text(node))["/**"]["ros__parameters"]
    for item in options(write_config.table_of(node)):
        value = values
        for part in item.name.split("."):
            value = value[part]
        assert type(value) is item.kind, item.name
        both_nan = value != value and item.default != item.default
        assert value == item.default or both_nan, item.name
        assert item.objection(item.default) == "", item.name
        assert item.description.endswith("."), item.name


def test_an_integer_counts_as_a_number_but_not_the_other_way_round() -> None:
    assert type(OPTIONS["inner.gain"].normalised(4)) is float
    checked = Checked(np.float32(1.0), gradual=np.bool_(False))  # type: ignore[arg-type]
    assert (type(checked.speed), checked.gradual) == (float, False)
    assert OPTIONS["count"].normalised(4.0) == 4.0
    assert OPTIONS["count"].objection(OPTIONS["count"].normalised(4.0))
