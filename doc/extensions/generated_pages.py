"""Pages that are made from the code: force laws, nodes, messages, programs, figures of the law."""

from __future__ import annotations

import importlib
import math
import os
import pkgutil
import re
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from law_figures import coefficient_figure, shape_figure
from sphinx.ext.autodoc.mock import mock

from mr_damper_ros.models import MODELS
from mr_damper_ros.settings.option_table import options

ROOT = Path(__file__).resolve().parents[2]
MESSAGES = ROOT / "msg_defs"
POLICY = ROOT / "config" / "security" / "policy.xml"

ROS = [
    *("action_msgs", "ament_index_python", "builtin_interfaces", "diagnostic_msgs"),
    *("geometry_msgs", "lifecycle_msgs", "mr_damper_msgs", "rcl_interfaces", "rclpy"),
    *("rosgraph_msgs", "rosidl_runtime_py", "sensor_msgs", "std_msgs", "std_srvs"),
    "unique_identifier_msgs",
]
"""What the nodes import and the documentation does without."""

NODES = {
    "bridge": "An emulated rig, a bag, a record file or topics of other nodes become samples. "
    "A lifecycle node that starts by itself.",
    "campaign": "Chooses the runs of a test machine and has them made until the force is known "
    "([more](../planned_runs.md)).",
    "controller": "The current for a desired force, by the newest parameters.",
    "identifier": "A fit for every window, and now and then all parameters at once.",
    "live": "A page that shows the running system ([more](../live.md)).",
    "model": "The force predicted from displacement, current and parameters.",
    "supply": "The supply of the coil: commands in, measured current out. A lifecycle node that "
    "starts by itself.",
    "replay": "Plays a bag onto its topics, with `/clock`, for machines without `ros2 bag`.",
}

_YIELD = "$u_y$ is `yield_length`, $s$ is `share`; $z$ lies within −1 and 1."

SYMBOLS = {
    "bouc_wen": _YIELD,
    "modified_bouc_wen": _YIELD,
    "series_springs": "$\\varphi$ is `share`; see [springs in series](../series_springs.md).",
    "sigmoid": "How the coefficients follow from the parameters: [the sigmoid law]"
    "(../force_law.md).",
    "sigmoid_lag": "$x = v + v_h \\operatorname{sgn}(a) + v_d$; see "
    "[the extended law](../extended_law.md).",
}
"""What in an equation is not named as the parameters are."""

PROGRAMS = (
    "check_rig",
    "import_record",
    "identify",
    "export",
    "identify_many",
    "plan_run",
    "validate",
    "watch",
    "demo",
)

TYPES = {
    "mts/samples": "MtsSamples",
    "rig/excitation_command": "ExcitationCommand",
    "supply/current": "SupplyCurrent",
    "supply/current_command": "CurrentCommand",
    "temperature": "sensor_msgs/Temperature",
    "joint_states": "sensor_msgs/JointState",
    "damper/parameters": "DamperParameters",
    "damper/fit_report": "FitReport",
    "damper/fluid_temperature": "sensor_msgs/Temperature",
    "damper/predicted_force": "PredictedForce",
    "damper/predicted_wrench": "geometry_msgs/WrenchStamped",
    "damper/signals": "DamperSignals",
    "damper/identified": "diagnostic_msgs/DiagnosticArray",
    "damper/desired_force": "DesiredForce",
    "/diagnostics": "diagnostic_msgs/DiagnosticArray",
}
"""Type of each topic; of those named here without a package, the fields are on the messages' page.
"""

REPLAY = "Publishes what is in the bag, and `/clock`. Services: `~/pause`, `~/resume`, `~/step`."

_USUAL = re.compile(
    r"(describe|get|list|set)_\w*(parameters?|types?)(_atomically|_description)?"
    r"|change_state|get_\w*(states?|transitions?|transition_graph)"
)
"""Services of every node and of every lifecycle node."""

_CONSTANT = re.compile(r"\w+ (\w+)\s*=\s*(\S+)\s*(?:#\s*(.*))?$")
"""A constant of a message: name, value, meaning."""


def models_page() -> str:
    """Every force law with its equation, its source and its parameters."""
    parts = [
        "# The force laws",
        "",
        "Any of them can be identified, over many runs too, and predicts forces in the nodes. The "
        "default is `sigmoid`, explained in [the sigmoid law](../force_law.md). Displacement $u$ "
        "is counted from the centre of the motion, $v$ is the velocity, $a$ the acceleration, $i$ "
        "the current.",
        "",
        "A law that was published for a single current is given the usual dependence on it: a "
        "coefficient $c$ that cannot be negative grows as $c\\,(1 + c_1 i + c_2 i^2)$, one of "
        "either sign is shifted, $c + c_1 i + c_2 i^2$. The parameters that end in `_1` and `_2` "
        "are these. The current of the coil follows that of the supply with `coil_time_constant`.",
        "",
    ]
    for name, model in MODELS.items():
        title = model.title[0].upper() + model.title[1:]
        parts += [f"## {title}", "", f"`{name}`", "", "$$", _drawable(model.equation), "$$", ""]
        parts += [f"{SYMBOLS.get(name, '')} Source: {model.source}.", ""]
        meanings = {quantity.name: quantity.meaning for quantity in model.coefficient_quantities}
        rows = [
            (f"`{p.name}`", p.unit, _bounds(p.low, p.high), meanings.get(p.name, ""))
            for p in model.parameters
        ]
        parts += _table(("parameter", "unit", "bounds", "meaning"), rows)
    return "\n".join(parts)


def _drawable(equation: str) -> str:
    """An equation in lines of their own, with bars and signs that are set as those of functions."""
    equation = re.sub(r"\|(\w)\|", r"{\\left| \1 \\right|}", equation)
    equation = re.sub(r"\\operatorname\{sgn\} (\w)", r"\\operatorname{sgn}(\1)", equation)
    return equation.replace(r",\quad", r" \\ ")


def nodes_page() -> str:
    """Every node with its topics, services and parameters."""
    parts = [
        "# The nodes",
        "",
        "Names are relative: in a namespace every damper has its own, and every one can be "
        "remapped. The quality of service of each topic is in "
        "[Quality of service](../quality_of_service.md).",
        "",
    ]
    profiles = _profiles()
    for node, tables in _parameter_tables().items():
        parts += [f"## {node}", "", NODES[node], ""]
        parts += profiles.get(node, [REPLAY, ""])
        parts += [f"### Parameters of {node}", ""]
        parts += _definitions(tables)
    return "\n".join(parts)


def messages_page() -> str:
    """Every message, service and action with its fields, units and comments."""
    parts = ["# Messages, services, actions", "", "All are in the package `mr_damper_msgs`.", ""]
    kinds = {"msg": "Messages", "srv": "Services", "action": "Actions"}
    for folder, title in kinds.items():
        parts += [f"## {title}", ""]
        for path in sorted((MESSAGES / folder).glob(f"*.{folder}")):
            parts += [f"### {path.stem}", ""]
            sections = re.split(r"^---$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
            heads = {1: [""], 2: ["Request", "Response"], 3: ["Goal", "Result", "Feedback"]}
            for head, section in zip(heads[len(sections)], sections, strict=True):
                parts += _fields(head, section)
    return "\n".join(parts)


def programs_page() -> str:
    """What every command-line program says of itself."""
    parts = ["# The programs", "", "Run them after `. ./env.bash`, or with `ros2 run`.", ""]
    for name in PROGRAMS:
        text = StringIO()
        os.environ["COLUMNS"] = "78"  # the width that argparse writes for
        program = importlib.import_module(f"mr_damper_ros.tools.{name}")
        with redirect_stdout(text), suppress(SystemExit):
            program.main(["--help"])
        parts += [f"## {name}", "", "```text", text.getvalue().rstrip(), "```", ""]
    return "\n".join(parts)


def _bounds(low: float, high: float) -> str:
    if math.isinf(high):
        return "" if math.isinf(low) else f"at least {low:g}"
    return f"{low:g} to {high:g}"


def _fields(head: str, section: str) -> Iterator[str]:
    """The fields of one part of an interface; a comment that stands alone introduces the part."""
    if head:
        yield from (f"*{head}*", "")
    entries = []
    for paragraph in re.split(r"\n\s*\n", section.strip()):
        lines = paragraph.splitlines()
        comment = " ".join(line.lstrip("# ") for line in lines if line.startswith("#"))
        rest = [line for line in lines if not line.startswith("#")]
        constants = [found for line in rest if (found := _CONSTANT.match(line))]
        fields = [line.split()[:2] for line in rest if not _CONSTANT.match(line)]
        comment += "".join(f"\n\n  - `{c[1]}` = {c[2]}: {c[3]}" for c in constants)
        if fields:
            term = ", ".join(f"`{name}`" for _, name in fields)
            entries.append((term, f"`{fields[0][0]}`", comment))
        elif constants:
            entries.append(("constants", f"`{rest[0].split()[0]}`", comment.strip()))
        else:
            yield from (comment, "")
    yield from _definitions(entries)


def _profiles() -> dict[str, list[str]]:
    """Topics and services of the nodes, as the policy of SROS2 has them, which a test checks."""
    found = {}
    for profile in ElementTree.parse(POLICY).iter("profile"):
        lines: list[str] = []
        for title, kind, tag in (
            ("Publishes", "publish", "topic"),
            ("Subscribes", "subscribe", "topic"),
        ):
            names = [
                str(entry.text)
                for topics in profile.iter("topics")
                if topics.get(kind) == "ALLOW"
                for entry in topics.iter(tag)
            ]
            shown = [f"`{name}` ({TYPES[name]})" for name in names if name in TYPES]
            if shown:
                lines += [f"{title}: {', '.join(shown)}.", ""]
        services = [str(entry.text) for entry in profile.iter("service")]
        own = [name for name in services if not _USUAL.fullmatch(name[2:])]
        actions = [f"`{entry.text}` (action)" for entry in profile.iter("action")]
        if own or actions:
            offered = [f"`{name}`" for name in own] + actions
            lines += [f"Offers: {', '.join(offered)}.", ""]
        found[str(profile.get("node"))] = lines
    return found


def _parameter_tables() -> dict[str, list[tuple[str, ...]]]:
    """Rows of the parameters of each node, from the tables that declare them."""
    with mock(ROS):
        package = importlib.import_module("mr_damper_ros.nodes")
        by_name: dict[str, Any] = {}
        for module in pkgutil.iter_modules(package.__path__, "mr_damper_ros.nodes."):
            by_name.update(vars(importlib.import_module(module.name)))
        return {
            node: [_row(item) for item in options(by_name[f"{node.capitalize()}Parameters"])]
            for node in NODES
        }


def _row(item: Any) -> tuple[str, ...]:
    meaning = item.description
    limits = [", ".join(f"`{choice}`" for choice in item.choices), item.range_text]
    meaning += "".join(f" ({limit})" for limit in limits if limit)
    default = '""' if item.default == "" else str(item.default).replace("True", "true")
    return f"`{item.name}`", f"default `{default.replace('False', 'false')}`", meaning


def _definitions(entries: list[tuple[str, ...]]) -> list[str]:
    """Terms, each with a note, and what they mean: readable on a narrow screen too."""
    lines = []
    for term, note, meaning in entries:
        lines += [f"{term} ({note})", f": {meaning}", ""]
    return lines


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """A table in Markdown; columns with nothing in them are left out."""
    kept = [place for place in range(len(head)) if any(row[place] for row in rows)]
    lines = [[row[place] for place in kept] for row in (head, ("---",) * len(head), *rows)]
    return [*("| " + " | ".join(line) + " |" for line in lines), ""]


def _generate(app: Any) -> None:
    folder = Path(app.srcdir) / "generated"
    folder.mkdir(exist_ok=True)
    for name, page in (
        ("models", models_page),
        ("nodes", nodes_page),
        ("messages", messages_page),
        ("programs", programs_page),
    ):
        _write(folder / f"{name}.md", page())
    coefficient_figure(folder / "coefficients.svg")
    shape_figure(folder / "shapes.svg")


def _write(path: Path, text: str) -> None:
    """Write a page unless it is the same as before, which then need not be built again."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def setup(app: Any) -> dict[str, bool]:
    """Make the pages before Sphinx looks for them."""
    app.connect("builder-inited", _generate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
