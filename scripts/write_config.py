"""Writes ``config/*.yaml`` from the parameter tables of the nodes (``make config``)."""

from __future__ import annotations

import dataclasses
import inspect
import textwrap
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import yaml

from mr_damper_ros.emulation.emulator import invented_damper
from mr_damper_ros.settings.option_table import Option, ParameterTable, options, tables_of

CONFIG = Path(__file__).resolve().parents[1] / "config"

NODES = (
    *("bridge", "campaign", "controller", "identifier", "live", "model", "replay", "supply"),
    "suspension",
)

MANAGED = ("bridge", "supply")
"""Lifecycle nodes, whose fixed parameters may be set while the node is not configured."""

EXAMPLES = {"campaign": "-p folder:=/data/damper_7", "replay": "-p bag:=bags/5.0mm_1Hz_1.5A"}
"""Arguments that a node needs in addition to its parameter file."""

COIL = 0.01
"""Coil time constant [s] of the invented damper, the default of the bridge."""

WIDTH = 100


def table_of(node: str) -> type[ParameterTable]:
    """The parameter table of a node; importing it needs ROS."""
    module = import_module(f"mr_damper_ros.nodes.{node}_node")
    table: type[ParameterTable] = getattr(module, f"{node.capitalize()}Parameters")
    return table


def config_text(node: str) -> str:
    """The parameter file of a node: its defaults with descriptions."""
    table = table_of(node)
    _, _, purpose = (inspect.getdoc(table) or "").partition("\n\n")
    command = f"ros2 run mr_damper_ros {node} --ros-args --params-file {node}.yaml"
    lines = [
        *_comment(f"Parameters of the node `{node}`, with their defaults. {_fixed(node, table)}"),
        "#",
        f"#     {command} {EXAMPLES.get(node, '')}".rstrip(),
        "#",
        *_comment(purpose),
        "/**:",
        "  ros__parameters:",
    ]
    parents: list[str] = []
    headings = dict(_headings(table))
    for item in options(table):
        *groups, name = item.name.split(".")
        for depth, group in enumerate(groups):
            if parents[: depth + 1] != groups[: depth + 1]:
                indent = "  " * (depth + 2)
                lines += _comment(headings[".".join(groups[: depth + 1])], indent)
                lines.append(f"{indent}{group}:")
        parents = groups
        indent = "  " * (len(groups) + 2)
        lines += [*_comment(item.description, indent), f"{indent}{name}: {_value(item)}", ""]
    return "\n".join(lines[:-1]) + "\n"


def _fixed(node: str, table: type[ParameterTable]) -> str:
    """A sentence on which parameters are fixed, and when."""
    free = [item.name for item in options(table) if not item.read_only]
    all_but = f"All but {', '.join(free)} are" if free else "All are"
    if node not in MANAGED:
        return f"{all_but} fixed while the node runs."
    at_start = [item.name for item in options(table) if item.start_only]
    return (
        f"{all_but} fixed while the node is configured, and may be set before and after "
        f"({', '.join(at_start)}: only at the start of the node)."
    )


def _headings(table: type, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Heading of each group of options: the first paragraph of its table's docstring."""
    for field in dataclasses.fields(table):
        for own, part in tables_of(field).values():
            if own:
                first = (inspect.getdoc(part) or "").partition("\n\n")[0]
                yield prefix + own.rstrip("."), first
            yield from _headings(part, prefix + own)


def _comment(text: str, indent: str = "") -> list[str]:
    words = " ".join(text.split()).replace("``", "`")
    return textwrap.wrap(
        words,
        WIDTH,
        initial_indent=f"{indent}# ",
        subsequent_indent=f"{indent}# ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def _value(item: Option) -> str:
    if item.default == "":
        return '""'
    return yaml.safe_dump(item.default).splitlines()[0]


def texts() -> dict[str, str]:
    """The text of every generated file, by file name."""
    files = {f"{node}.yaml": config_text(node) for node in NODES}
    return files | {"invented_damper.yaml": invented_damper(COIL).to_yaml()}


def main() -> None:
    """Write the files."""
    for name, text in texts().items():
        (CONFIG / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
