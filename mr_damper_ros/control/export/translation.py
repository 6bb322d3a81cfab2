"""Formulas in other languages: expressions of Python become those of C and of M-code."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass

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
