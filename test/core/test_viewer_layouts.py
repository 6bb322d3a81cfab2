"""The layouts for ROS viewers use existing topics and fields."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from mr_damper_ros.models import MODELS

ROOT = Path(__file__).parents[2]
VIEWERS = ROOT / "config" / "viewers"
SIGMOID = MODELS["sigmoid"]
MESSAGES = {"damper/signals": "DamperSignals", "damper/fit_report": "FitReport"}


def scalars(message: str) -> set[str]:
    """Names of the numeric fields of a message of this package."""
    text = (ROOT / "msg_defs" / "msg" / f"{message}.msg").read_text(encoding="utf-8")
    return set(re.findall(r"^(?:float64|bool|u?int\d+) (\w+)$", text, re.MULTILINE))


def known() -> set[tuple[str, ...]]:
    """All drawable values: topic, then name, or kind and name."""
    fields = {(topic, name) for topic, message in MESSAGES.items() for name in scalars(message)}
    named = {
        ("damper/identified", kind, name)
        for kind, names in (
            ("coefficients", SIGMOID.coefficient_names),
            ("parameters", SIGMOID.parameter_names),
        )
        for name in names
    }
    return fields | named | {("damper/fluid_temperature", "temperature")}


def drawn_by_plotjuggler() -> set[tuple[str, ...]]:
    root = ElementTree.parse(VIEWERS / "plotjuggler.xml").getroot()
    topics = {topic.get("name", "") for topic in root.iter("topic")}
    drawn = set()
    for curve in root.iter("curve"):
        names = [curve.get("curve_x"), curve.get("curve_y")]
        for name in [name for name in names if name] or [curve.get("name", "")]:
            (topic,) = (topic for topic in topics if name.startswith(f"{topic}/"))
            rest = name.removeprefix(f"{topic}/").split("/")
            drawn.add((topic.removeprefix("/"), *rest))
    return drawn


def drawn_by_lichtblick() -> set[tuple[str, ...]]:
    layout = json.loads((VIEWERS / "lichtblick.json").read_text(encoding="utf-8"))
    drawn = set()
    for panel in layout["configById"].values():
        for path in [*panel.get("paths", ()), *filter(None, [panel.get("xAxisPath")])]:
            topic, _, rest = path["value"].removeprefix("/").partition(".")
            named = re.fullmatch(
                r'status\[:\]{name=="(\w+)"}\.values\[:\]{key=="(\w+)"}\.value', rest
            )
            drawn.add((topic, *(named.groups() if named else (rest,))))
    return drawn


@pytest.mark.parametrize("drawn", [drawn_by_plotjuggler, drawn_by_lichtblick])
def test_a_layout_draws_what_there_is_and_every_coefficient_and_parameter(drawn) -> None:
    shown = drawn()
    assert shown <= known()
    identified = {entry for entry in known() if entry[0] == "damper/identified"}
    assert identified <= shown
    assert {("damper/signals", "measured_force"), ("damper/signals", "velocity")} <= shown
