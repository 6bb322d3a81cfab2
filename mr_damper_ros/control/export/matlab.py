"""The law as M-code, for MATLAB and Octave: coefficients, force, inverse, element by element."""

from __future__ import annotations

from mr_damper_ros.control.export.c_header import filled, template
from mr_damper_ros.control.export.exported_law import ExportedLaw, number
from mr_damper_ros.control.export.translation import M, lines


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
