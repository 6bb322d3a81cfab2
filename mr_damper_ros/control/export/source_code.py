"""The law as a C99 header and as M-code: expressions of Python become those of the languages."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources

from mr_damper_ros.control.export.exported_law import ExportedLaw, ExportError, number
from mr_damper_ros.kinematics.peak_velocity import MEMORY

_COMPARISONS: dict[type, str] = {ast.GtE: ">=", ast.Lt: "<"}

_LEVELS: dict[type, int] = {ast.Add: 1, ast.Sub: 1, ast.Mult: 2, ast.Div: 2}


@dataclass(frozen=True)
class Language:
    """How a language writes operators and the functions of the formulas."""

    operators: Mapping[type, str]
    functions: Mapping[str, str]
    assignment: str
    """With ``{name}`` and ``{value}``."""


C = Language(
    operators={ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"},
    functions={
        "exp": "exp",
        "tanh": "tanh",
        "abs": "fabs",
        **{name: f"@NAME@_{name}" for name in ("clip", "larger", "where", "sat", "number")},
    },
    assignment="const double {name} = {value};",
)
"""C99."""

M = Language(
    operators={ast.Add: "+", ast.Sub: "-", ast.Mult: ".*", ast.Div: "./"},
    functions={
        **{name: name for name in ("exp", "tanh", "abs")},
        **{name: f"damper_{name}" for name in ("clip", "larger", "where", "sat", "number")},
    },
    assignment="{name} = {value};",
)
"""MATLAB and Octave, element by element."""


def lines(formulas: tuple[tuple[str, str], ...], language: Language) -> list[str]:
    """The formulas as assignments, one a line."""
    return [
        language.assignment.format(name=name, value=expression(text, language))
        for name, text in formulas
    ]


def expression(text: str, language: Language) -> str:
    """An expression in another language; raises ValueError for what is no formula."""
    return _written(ast.parse(text, mode="eval").body, language)


def _written(node: ast.expr, language: Language) -> str:
    match node:
        case ast.Constant(value=float(number)):
            return repr(number)
        case ast.Name(id=name):
            return name
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return f"-{_operand(operand, language, 2)}"
        case ast.BinOp(left=left, op=operator, right=right):
            level = _LEVELS[type(operator)]
            sign = language.operators[type(operator)]
            # What stands to the right is computed first only in brackets.
            before, after = _operand(left, language, level), _operand(right, language, level + 1)
            return f"{before} {sign} {after}"
        case ast.Compare(left=left, ops=[operator], comparators=[right]):
            sign = _COMPARISONS[type(operator)]
            return f"{_written(left, language)} {sign} {_written(right, language)}"
        case ast.Call(func=ast.Name(id=name), args=arguments):
            inner = ", ".join(_written(argument, language) for argument in arguments)
            return f"{language.functions[name]}({inner})"
    raise ValueError(f"{ast.unparse(node)} cannot be written in another language")


def _operand(node: ast.expr, language: Language, level: int) -> str:
    text = _written(node, language)
    weaker = isinstance(node, ast.BinOp) and _LEVELS[type(node.op)] < level
    return f"({text})" if weaker else text


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


def functions(law: ExportedLaw) -> dict[str, str]:
    """The text of each file by its name."""
    formulas = (*law.formulas.coefficients, *law.formulas.force)
    values = {
        "PROVENANCE": law.provenance,
        "CONSTANTS": "\n".join(f"{name} = {number(v)};" for name, v in law.constants.items()),
        "COEFFICIENTS": "\n".join(lines(law.formulas.coefficients, M)),
        "FORMULAS": "\n".join(lines(formulas, M)),
        "LOWEST": number(float(law.nodes[0])),
        "HIGHEST": number(float(law.nodes[-1])),
        "NODES": " ".join(map(number, law.nodes)),
        "HELD_LOW": number(law.held[0]),
        "HELD_HIGH": number(law.held[1]),
    }
    names = ("damper_force", "damper_coefficients", "damper_inverse", "damper_check")
    texts = {f"{name}.m": filled(template(f"{name}.m.in"), values) for name in names}
    for name, body in _HELPERS.items():
        texts[f"damper_{name}.m"] = f"function r = damper_{body}\nend\n"
    return texts


_HELPERS = {
    "sat": "sat(x)\n% Within 1e100.\nr = min(max(x, -1e100), 1e100);",
    "clip": "clip(x, low, high)\n% Within two limits.\nr = min(max(x, low), high);",
    "larger": "larger(x, y)\nr = max(x, y);",
    "where": (
        "where(condition, yes, no)\n% One or the other, element by element.\n"
        "none = zeros(size(condition + yes + no));\n"
        "r = none + no;\nyes = none + yes;\nplaces = (none + condition) ~= 0;\n"
        "r(places) = yes(places);"
    ),
    "number": "number(x)\n% 0 where x is none.\nr = x;\nr(isnan(x)) = 0;",
}
