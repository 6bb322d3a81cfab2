"""Laws as formulas, which are differentiated, compiled, and translated to other languages.

A formula is a name and a Python expression. It may contain numbers, inputs, earlier formulas, the
operators ``+ - * / < >=`` and the functions ``exp``, ``expm1``, ``tanh``, ``abs``, ``clip(x, low,
high)``, ``larger(x, y)``, ``where(condition, yes, no)``, ``sat(x)`` (x limited to ±1e100) and
``number(x)`` (0 in place of NaN).
"""

from __future__ import annotations

import ast
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import count
from typing import Any, NamedTuple

import numpy as np

Formulas = tuple[tuple[str, str], ...]


class WrittenLaw(NamedTuple):
    """The formulas of a law, for other languages.

    Inputs of the ``coefficients`` are the parameters, the peak velocity v_m [m/s] and the coil
    current i [A]; of the ``force`` also the velocity v [m/s], the branch s of the hysteresis at the
    previous sample and the ``change`` of the velocity since then [m/s].
    """

    parameter_names: tuple[str, ...]
    coefficients: Formulas
    force: Formulas
    coefficient_names: tuple[str, ...]


LIMIT = 1e100
"""Limit of ``sat``; the product of up to three such quantities does not overflow."""


def staged(
    formulas: Formulas, stages: Sequence[Sequence[str]], results: Sequence[str], scalars: int = 0
) -> Callable[..., Any]:
    """Compile the formulas: ``staged(...)(*stages[0])(*stages[1])...`` returns the results.

    ``stages`` names the inputs that become known together; an input may be the name of a formula.
    Each part of an expression is computed at the first stage at which its inputs are known, so a
    function kept from an earlier stage does not compute it again. Several results are returned as a
    tuple. The inputs of the first ``scalars`` stages are floats. Other inputs are arrays, which
    broadcast; inputs of the first stage may also be floats.
    """
    known = {name: stage for stage, names in enumerate(stages) for name in names}
    lines = [(name, _tree(text)) for name, text in _needed(formulas, results, known)]
    uses = Counter(_text(node) for _, tree in lines for node in ast.walk(tree))
    styles = [_SCALARS] * scalars + [_ARRAYS] * (len(stages) - scalars)
    bodies: list[list[str]] = [[] for _ in stages]
    stored: dict[str, str] = {}
    unused = (f"part_{number}" for number in count())

    def stage_of(tree: ast.expr) -> int:
        return max((known[name] for name in _names(tree)), default=0)

    def write(node: ast.expr, stage: int) -> str:
        return _written(node, styles[stage], lambda each, _: part(each, stage), next(unused))

    def part(node: ast.expr, stage: int) -> str:
        """Part of an expression; stored if it belongs to an earlier stage or is repeated."""
        own, text = stage_of(node), _text(node)
        if isinstance(node, (ast.Name, ast.Constant)) or (own == stage and uses[text] == 1):
            return write(node, own)
        if text not in stored:
            stored[text] = next(unused)
            bodies[own].append(f"{stored[text]} = {write(node, own)}")
        return stored[text]

    for name, tree in lines:
        stage = stage_of(tree)
        bodies[stage].append(f"{name} = {write(tree, stage)}")
        known[name] = stage
    code = []
    for stage, inputs in enumerate(stages):
        code.append("    " * stage + f"def stage_{stage}({', '.join(inputs)}):")
        code += ["    " * (stage + 1) + line for line in bodies[stage]]
    last = len(stages)
    code.append("    " * last + f"return {', '.join(results)}")
    code += ["    " * stage + f"return stage_{stage}" for stage in range(last - 1, 0, -1)]
    space = {**_SCALAR_FUNCTIONS, **_ARRAY_FUNCTIONS}
    # The package itself writes the formulas.
    exec(compile("\n".join(code), "<formulas>", "exec"), space)
    made: Callable[..., Any] = space["stage_0"]
    return made


def gradient(
    formulas: Formulas, result: str, by: Sequence[str], given: Sequence[str] = ()
) -> Formulas:
    """The formulas with the derivatives of one result, named ``{result}_by_{input}``.

    The inputs ``given`` do not depend on the inputs ``by``. Reverse-mode differentiation takes
    about as many operations as the result itself, for any number of inputs. ``sat``, ``clip`` and
    ``number`` are differentiated like the identity. Raises ValueError if ``exp`` or ``tanh`` is
    only a part of a formula, and for a function without derivative.
    """
    lines = list(_needed(formulas, [result], dict.fromkeys((*by, *given), 0)))
    moving = set(by)
    for name, text in lines:
        if _names(_tree(text)) & moving:
            moving.add(name)
    parts: dict[str, list[str]] = {name: [] for name in (*by, *moving)}
    parts[result] = ["1.0"]
    found: list[tuple[str, str]] = []
    for name, text in reversed(lines):
        if name not in moving:
            continue
        own, tree = _sum(parts[name]), _tree(text)
        if not isinstance(_tree(own), (ast.Name, ast.Constant)):
            found.append((f"{result}_by_{name}", own))
            own = f"{result}_by_{name}"
        for inner in sorted(_names(tree) & moving):
            parts[inner].append(_product(own, _derivative(tree, inner, name, tree)))
    ends = tuple((f"{result}_by_{name}", _sum(parts[name])) for name in by)
    return (*formulas, *found, *ends)


def _needed(
    formulas: Formulas, results: Sequence[str], known: Mapping[str, int]
) -> Iterator[tuple[str, str]]:
    """The formulas that the results need, in order."""
    wanted = set(results) - set(known)
    for name, text in reversed(formulas):
        if name in wanted:
            wanted |= _names(_tree(text)) - set(known)
    return ((name, text) for name, text in formulas if name in wanted and name not in known)


# Several laws are compiled from the same formulas, so their parts are kept.
@cache
def _tree(text: str) -> ast.expr:
    return ast.parse(text, mode="eval").body


_text = cache(ast.unparse)


@cache
def _names(tree: ast.AST) -> set[str]:
    functions = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    every = (node for node in ast.walk(tree) if isinstance(node, ast.Name))
    return {node.id for node in every if id(node) not in functions}


# -- derivatives


def _derivative(node: ast.expr, by: str, name: str, line: ast.expr) -> str:
    """Derivative of a part of the formula ``name`` with respect to one of the names in it."""
    if by not in _names(node):
        return "0.0"
    text = _text
    match node:
        case ast.Name():
            return "1.0"
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return _product("-1.0", _derivative(operand, by, name, line))
        case ast.BinOp(left=left, op=operator, right=right):
            first, second = (_derivative(side, by, name, line) for side in (left, right))
            match operator:
                case ast.Add():
                    return _sum([first, second])
                case ast.Sub():
                    return _sum([first, _product("-1.0", second)])
                case ast.Mult():
                    return _sum([_product(first, text(right)), _product(text(left), second)])
            second = _product(f"-({text(left)}) / (({text(right)}) * ({text(right)}))", second)
            return _sum([first if first == "0.0" else f"({first}) / ({text(right)})", second])
        case ast.Call(func=ast.Name(id=function), args=[inner, *others]):
            if function == "where":
                yes, no = (_derivative(other, by, name, line) for other in others)
                return "0.0" if yes == no == "0.0" else f"where({text(inner)}, {yes}, {no})"
            if function in ("sat", "clip", "number"):
                return _derivative(inner, by, name, line)
            if function in ("tanh", "exp") and node is line:
                slope = name if function == "exp" else f"1.0 - {name} * {name}"
                return _product(slope, _derivative(inner, by, name, line))
    raise ValueError(f"{text(node)} in the formula of {name} has no derivative by {by}")


def _sum(parts: Sequence[str]) -> str:
    some = [part for part in parts if part != "0.0"]
    return " + ".join(f"({part})" for part in some) if len(some) > 1 else "".join(some) or "0.0"


def _product(first: str, second: str) -> str:
    if "0.0" in (first, second):
        return "0.0"
    if "1.0" in (first, second):
        return second if first == "1.0" else first
    return f"({first}) * ({second})"


# -- languages


Style = Mapping[type | str, str]
"""How a language writes each operator, by its class in :mod:`ast`, and each function, by its name.

``{0}``, ``{1}`` and so on are the operands, ``{all}`` a list of them, and ``{new}`` is an unused
name. The key ``=`` belongs to an assignment of ``{1}`` to ``{0}``.
"""

OPERATORS: Style = {
    ast.USub: "-{0}",
    ast.Add: "{0} + {1}",
    ast.Sub: "{0} - {1}",
    ast.Mult: "{0} * {1}",
    ast.Div: "{0} / {1}",
    ast.Lt: "{0} < {1}",
    ast.GtE: "{0} >= {1}",
}
"""Operators as most languages write them."""

_LEVELS: dict[type, int] = {ast.Add: 1, ast.Sub: 1, ast.Mult: 2, ast.Div: 2, ast.USub: 2}
"""Precedence of an operator."""


def _written(
    node: ast.expr, style: Style, inner: Callable[[ast.expr, int], str], new: str = ""
) -> str:
    """Write a part of a formula; ``inner`` writes an operand, in brackets if necessary."""
    key: type | str = ""
    match node:
        case ast.Constant(value=float(number)):
            return repr(number)
        case ast.Name(id=name):
            return name
        case ast.UnaryOp(op=operator, operand=operand):
            key, operands = type(operator), [operand]
        case ast.BinOp(left=left, op=operator, right=right):
            key, operands = type(operator), [left, right]
        case ast.Compare(left=left, ops=[comparison], comparators=[right]):
            key, operands = type(comparison), [left, right]
        case ast.Call(func=ast.Name(id=function), args=operands):
            key = function
    if key not in style:
        raise ValueError(f"{ast.unparse(node)} is not allowed in a formula")
    # A right operand needs brackets to be computed first.
    level = _LEVELS.get(key, 0) if isinstance(key, type) else 0
    parts = [inner(each, level and level + place) for place, each in enumerate(operands)]
    return style[key].format(*parts, all=", ".join(parts), new=new)


def assignments(formulas: Sequence[tuple[str, str]], style: Style) -> list[str]:
    """The formulas in a language, one a line, without redundant brackets.

    Raises ValueError for an invalid formula.
    """

    def operand(node: ast.expr, level: int) -> str:
        weaker = isinstance(node, ast.BinOp) and _LEVELS.get(type(node.op), 0) < level
        return f"({_written(node, style, operand)})" if weaker else _written(node, style, operand)

    return [style["="].format(name, operand(_tree(text), 0)) for name, text in formulas]


_BRACKETED = {key: f"({text})" for key, text in OPERATORS.items()}

_CLIPPED = "({new} if {1} <= ({new} := {0}) <= {2} else clip({new}, {1}, {2}))"

# Scalar code without calls where possible: a call takes as long as ten sums. Division by zero gives
# the same result as with arrays.
_SCALARS: Style = {
    **_BRACKETED,
    ast.Div: "({0} / {new} if ({new} := {1}) else over({0}))",
    **{name: name + "({0})" for name in ("exp", "expm1", "tanh", "abs")},
    "clip": _CLIPPED,
    "sat": _CLIPPED.replace("{1}", repr(-LIMIT)).replace("{2}", repr(LIMIT)),
    "larger": "({new} if ({new} := {0}) > {1} else {1})",
    "number": "({new} if ({new} := {0}) == {new} else 0.0)",
    "where": "({1} if {0} else {2})",
}

_SCALAR_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "exp": math.exp,
    "expm1": math.expm1,
    "tanh": math.tanh,
    "clip": lambda x, low, high: high if x > high else low if x < low else x,
    "over": lambda x: math.nan if x != x or x == 0.0 else math.copysign(math.inf, x),
}

_ARRAY_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "each_exp": np.exp,
    "each_expm1": np.expm1,
    "each_tanh": np.tanh,
    "each_abs": np.abs,
    "each_where": np.where,
    # The method takes half the time of np.clip, which matters for blocks of a few samples.
    "each_clip": lambda x, low, high: x.clip(low, high),
    "each_sat": lambda x: x.clip(-LIMIT, LIMIT),
    "each_larger": np.maximum,
    "each_number": lambda x: np.where(x == x, x, 0.0),
}

_ARRAYS: Style = _BRACKETED | {
    name.removeprefix("each_"): name + "({all})" for name in _ARRAY_FUNCTIONS
}
