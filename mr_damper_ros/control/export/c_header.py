"""The law as a C99 header."""

from __future__ import annotations

import re
from importlib import resources

from mr_damper_ros.control.export.exported_law import ExportedLaw, ExportError, number
from mr_damper_ros.control.export.translation import C, lines
from mr_damper_ros.kinematics.peak_velocity import MEMORY

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,40}")


def template(file: str) -> str:
    """The text of a template of this folder."""
    return resources.files(__package__).joinpath(file).read_text("utf-8")


def filled(text: str, values: dict[str, str]) -> str:
    """A template with every ``@NAME@`` replaced."""
    for name, value in values.items():
        text = text.replace(f"@{name}@", value)
    return text


def header(law: ExportedLaw, name: str) -> str:
    """The header; all that it defines begins with ``name``. Raises ExportError for no such name."""
    if not _NAME.fullmatch(name):
        raise ExportError(
            f"'{name}' cannot be the name of something in C: begin with a letter, go on with "
            "letters, digits and underscores, 40 at most"
        )
    guard = name.upper()
    constants = (f"#define {guard}_{key} {number(value)}" for key, value in law.constants.items())
    formulas = lines((*law.formulas.coefficients, *law.formulas.force), C)
    body = "\n".join(f"  {_with_constants(line, law, guard)}" for line in formulas)
    low, high = law.held
    return filled(
        template("damper.h.in"),
        {
            "FORMULAS": body,
            "PROVENANCE": law.provenance.replace("*/", "* /"),
            "CONSTANTS": "\n".join(constants),
            "NODES": ", ".join(map(number, law.nodes)),
            "NODE_COUNT": str(law.nodes.size),
            "MATRIX": ", ".join("{" + ", ".join(map(number, row)) + "}" for row in law.observer),
            "GAIN": ", ".join(map(number, law.observer_gain)),
            "SETTLING": str(law.settling),
            "LONGEST": str(max(round(MEMORY / law.settings.period), 1)),
            "HELD_LOW": number(low),
            "HELD_HIGH": number(high),
            "PERIOD": number(law.settings.period),
            "GUARD": guard,
            "NAME": name,
        },
    )


def _with_constants(line: str, law: ExportedLaw, guard: str) -> str:
    names = "|".join(law.constants)
    return re.sub(rf"\b({names})\b", rf"{guard}_\1", line)
