"""The law as a C99 header and as M-code, generated from its formulas."""

from __future__ import annotations

import ast
import re
from importlib import resources

from mr_damper_ros.control.export.exported_law import ExportedLaw, number
from mr_damper_ros.kinematics.peak_velocity import MEMORY
from mr_damper_ros.models.formulas import OPERATORS, Style, assignments

_HELPERS = ("sat", "clip", "larger", "where", "number")
"""Functions of the generated code."""

C: Style = {
    **OPERATORS,
    **{name: name + "({all})" for name in ("exp", "tanh")},
    "abs": "fabs({all})",
    **{name: f"@NAME@_{name}({{all}})" for name in _HELPERS},
    "=": "const double {0} = {1};",
}
"""C99."""

M: Style = {
    **OPERATORS,
    ast.Mult: "{0} .* {1}",
    ast.Div: "{0} ./ {1}",
    **{name: name + "({all})" for name in ("exp", "tanh", "abs")},
    **{name: f"damper_{name}({{all}})" for name in _HELPERS},
    "=": "{0} = {1};",
}
"""MATLAB and Octave, element by element."""


_FILES = ("force", "coefficients", "inverse", "check", *_HELPERS)
"""Files of the M-code, without their prefix."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,40}")


def template(file: str) -> str:
    """The text of a template in this folder."""
    return resources.files(__package__).joinpath(file).read_text("utf-8")


def filled(text: str, values: dict[str, str]) -> str:
    """A template with every ``@NAME@`` replaced."""
    for name, value in values.items():
        text = text.replace(f"@{name}@", value)
    return text


def header(law: ExportedLaw, name: str) -> str:
    """The header; all its names begin with ``name``. Raises ValueError for an invalid name."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"'{name}' is not a valid C name: use a letter, followed by up to 40 letters, digits "
            "and underscores"
        )
    guard = name.upper()
    constants = (f"#define {guard}_{key} {number(value)}" for key, value in law.constants.items())
    formulas = assignments((*law.formulas.coefficients, *law.formulas.force), C)
    body = "\n".join(f"  {_with_constants(line, law, guard)}" for line in formulas)
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
            **_held(law),
            "PERIOD": number(law.settings.period),
            "GUARD": guard,
            "NAME": name,
        },
    )


def _held(law: ExportedLaw) -> dict[str, str]:
    """The range to which the law limits the peak velocity, as numbers and in words."""
    low, high = law.held
    words = f"{low:.4g} to {high:.4g} m/s"
    return {"HELD_LOW": number(low), "HELD_HIGH": number(high), "HELD_WORDS": words}


def _with_constants(line: str, law: ExportedLaw, guard: str) -> str:
    names = "|".join(law.constants)
    return re.sub(rf"\b({names})\b", rf"{guard}_\1", line)


def functions(law: ExportedLaw) -> dict[str, str]:
    """The text of each file by file name."""
    formulas = (*law.formulas.coefficients, *law.formulas.force)
    values = {
        "PROVENANCE": law.provenance,
        "CONSTANTS": "\n".join(f"{name} = {number(v)};" for name, v in law.constants.items()),
        "COEFFICIENTS": "\n".join(assignments(law.formulas.coefficients, M)),
        "FORMULAS": "\n".join(assignments(formulas, M)),
        "LOWEST": number(float(law.nodes[0])),
        "HIGHEST": number(float(law.nodes[-1])),
        "NODES": " ".join(map(number, law.nodes)),
        **_held(law),
    }
    return {f"damper_{name}.m": filled(template(f"damper_{name}.m.in"), values) for name in _FILES}
