"""Pages generated from the code: laws, nodes, messages, programs, findings, figures."""

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

from mr_damper_ros.__main__ import COMMANDS, main
from mr_damper_ros.data_check.findings import Kind
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
"""Imports of the nodes that the documentation replaces by mocks."""

NODES = {
    "bridge": "Publishes the samples of [a source](../sources.md). A lifecycle node that activates "
    "itself.",
    "campaign": "Chooses and commands the runs of a test machine until the force is known "
    "([planned runs](../planned_runs.md)).",
    "controller": "Commands the current for a desired force ([control](../control.md)).",
    "identifier": "Fits every window, and from time to time all parameters of the law "
    "([identification](../identification.md)).",
    "live": "Serves [a page](../live.md) that shows the running system.",
    "model": "Predicts the force from displacement, current and parameters "
    "([validity](../validity.md)).",
    "supply": "Drives [the supply](../supply.md) of the coil. A lifecycle node that activates "
    "itself.",
    "suspension": "Computes the desired force of a vehicle suspension "
    "([control](../control.md#the-desired-force)).",
    "replay": "Plays a bag onto its topics, with `/clock`.",
}

_YIELD = "$u_y$ is `yield_length`, $s$ is `share`; $z$ lies within −1 and 1."

SYMBOLS = {
    "bouc_wen": _YIELD,
    "modified_bouc_wen": _YIELD,
    "series_springs": "$\\varphi$ is `share`; see [springs in series](../series_springs.md).",
    "sigmoid": "[The sigmoid law](../force_law.md) gives the coefficients as functions of the "
    "parameters.",
    "sigmoid_lag": "$x = v + v_h \\operatorname{sgn}(a) + v_d$; see "
    "[the extended law](../extended_law.md).",
}
"""Symbols of an equation that differ from the names of the parameters."""

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
    "damper/joined_samples": "MtsSamples",
    "damper/joined_forces": "PredictedForce",
    "damper/desired_force": "DesiredForce",
    "/diagnostics": "diagnostic_msgs/DiagnosticArray",
}
"""Type of each topic; types without a package are on the page of the messages."""

SUSPENSION = (
    "Publishes: `damper/desired_force` (DesiredForce).",
    "",
    "Subscribes: `suspension/motion` (sensor_msgs/JointState).",
    "",
)
"""Topics of the node without an enclave in the policy."""

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
        "The default is `sigmoid`, explained in [the sigmoid law](../force_law.md). $u$ is the "
        "displacement from the centre of the motion, $v$ the velocity, $a$ the acceleration, $i$ "
        "the current.",
        "",
        "The parameters that end in `_1` and `_2` describe the dependence of a coefficient on the "
        "current ([laws published for one current]"
        "(../identification.md#laws-published-for-one-current)). The coil current follows the "
        "supply current with the time constant `coil_time_constant`.",
        "",
    ]
    for name, model in MODELS.items():
        title = model.title[0].upper() + model.title[1:]
        parts += [f"## {title}", "", f"`{name}`", "", "$$", _drawable(model.equation), "$$", ""]
        parts += [f"{SYMBOLS.get(name, '')} Source: {model.source}.", ""]
        meanings = {quantity.name: quantity.meaning for quantity in model.at_one_current}
        rows = [
            (f"`{p.name}`", p.unit, _bounds(p.low, p.high), meanings.get(p.name, ""))
            for p in model.parameters
        ]
        parts += _table(("parameter", "unit", "bounds", "meaning"), rows)
    return "\n".join(parts)


def _drawable(equation: str) -> str:
    """The equation on separate lines, with stretched bars and with brackets after sgn."""
    equation = re.sub(r"\|(\w)\|", r"{\\left| \1 \\right|}", equation)
    equation = re.sub(r"\\operatorname\{sgn\} (\w)", r"\\operatorname{sgn}(\1)", equation)
    return equation.replace(r",\quad", r" \\ ")


def nodes_page() -> str:
    """Every node with its topics, services and parameters."""
    parts = [
        "# The nodes",
        "",
        "Names are relative: each namespace has its own topics. [Quality of service]"
        "(../quality_of_service.md) lists the profile of each topic.",
        "",
    ]
    profiles = _profiles()
    for node, tables in _parameter_tables().items():
        parts += [f"## {node}", "", NODES[node], ""]
        parts += profiles.get(node, SUSPENSION)
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
    """The help text of every command."""
    parts = [
        "# The command mr-damper",
        "",
        "In a workspace: `ros2 run mr_damper_ros mr-damper`.",
        "",
    ]
    for name in COMMANDS:
        text = StringIO()
        os.environ["COLUMNS"] = "78"  # the width that argparse writes for
        with redirect_stdout(text), suppress(SystemExit):
            main([name, "--help"])
        parts += [f"## {name}", "", "```text", text.getvalue().rstrip(), "```", ""]
    return "\n".join(parts)


def findings_page() -> str:
    """Every finding of the check of the data, with its severity and its sentence."""
    rows = [
        (f"`{kind.name.lower()}`", kind.severity.name.lower(), kind.template.replace("|", "\\|"))
        for kind in Kind
    ]
    return "\n".join(
        [
            "# The findings",
            "",
            "What follows from a severity: [the check of the data](../data_check.md). Figures "
            "stand in braces.",
            "",
            *_table(("finding", "severity", "sentence"), rows),
        ]
    )


def _bounds(low: float, high: float) -> str:
    if math.isinf(high):
        return "" if math.isinf(low) else f"at least {low:g}"
    return f"{low:g} to {high:g}"


def _fields(head: str, section: str) -> Iterator[str]:
    """The fields of one part of an interface; a separate comment introduces the part."""
    if head:
        yield from (f"*{head}*", "")
    entries = []
    for paragraph in re.split(r"\n\s*\n", section.strip()):
        lines = paragraph.splitlines()
        comment = " ".join(line.lstrip("# ") for line in lines if line.startswith("#"))
        rest = [line for line in lines if not line.startswith("#")]
        constants = [found for line in rest if (found := _CONSTANT.match(line))]
        fields = [line.split()[:2] for line in rest if not _CONSTANT.match(line)]
        comment += "".join(
            f"\n\n  - `{c[1]}` = {c[2]}" + (f": {c[3]}" if c[3] else "") for c in constants
        )
        if fields:
            term = ", ".join(f"`{name}`" for _, name in fields)
            kinds = [kind for kind, _ in fields]
            shown = kinds if len(set(kinds)) > 1 else kinds[:1]
            entries.append((term, ", ".join(f"`{kind}`" for kind in shown), comment))
        elif constants:
            entries.append(("constants", f"`{rest[0].split()[0]}`", comment.strip()))
        else:
            yield from (comment, "")
    yield from _definitions(entries)


def _profiles() -> dict[str, list[str]]:
    """Topics and services of the nodes, from the policy of SROS2, which a test checks."""
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
    """A definition list of terms with notes, which a narrow screen shows well."""
    lines = []
    for term, note, meaning in entries:
        lines += [f"{term} ({note})", f": {meaning}", ""]
    return lines


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """A table in Markdown without its empty columns."""
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
        ("findings", findings_page),
    ):
        _write(folder / f"{name}.md", page())
    coefficient_figure(folder / "coefficients.svg")
    shape_figure(folder / "shapes.svg")


def _write(path: Path, text: str) -> None:
    """Write a page if it has changed; an unchanged page is not built again."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def setup(app: Any) -> dict[str, bool]:
    """Make the pages before Sphinx looks for them."""
    app.connect("builder-inited", _generate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
