"""The equations of the force laws as they stand in the documentation, by the model's name.

Displacement u from the centre of the motion, velocity v, acceleration a, current i.
"""

_HYSTERESIS = (
    r"\dot z = \frac{1}{\ell} \left( %(w)s - {\left| z \right|}^n"
    r" (s\,%(w)s + (1 - s)\,\left| %(w)s \right|\, \operatorname{sgn}(z)) \right)"
)

_LENGTH_AND_SHARE = "$\\ell$ is `yield_length`, $s$ is `share`; $z$ lies within −1 and 1."

EQUATIONS = {
    "bingham": (r"F = f_y\,\operatorname{sgn}(v) + c_0 v + f_0", ""),
    "hyperbolic_tangent": (
        r"F = c\,v + k\,u + \alpha\,\tanh(\beta v + \delta\,\operatorname{sgn}(u)) + f_0",
        "",
    ),
    "nonlinear_biviscous": (
        r"F = \min(\max(c_{\text{pre}}(v - v_0\,\operatorname{sgn}(a)),\;"
        r" c_{\text{post}} v - f_y),\; c_{\text{post}} v + f_y) + f_0",
        "",
    ),
    "bouc_wen": (
        r"F = c_0 v + k_0 u + f_0 + \alpha z \\ " + _HYSTERESIS % {"w": "v"},
        _LENGTH_AND_SHARE,
    ),
    "modified_bouc_wen": (
        r"F = c_1 \dot y + k_1 u + f_0 \\"
        r" \dot y = \frac{\alpha z + c_0 v + k_0 (u - y)}{c_0 + c_1} \\ "
        + _HYSTERESIS % {"w": "w"}
        + r" \\ w = v - \dot y",
        _LENGTH_AND_SHARE,
    ),
    "sigmoid": (
        r"F = \left( f_t\,\tanh\left(\frac{\alpha\,(v + v_h\,\operatorname{sgn}(a) + v_d)}{2}"
        r"\right) - f_d \right) (1 + k\,\left| v \right|)",
        "How the coefficients follow from the parameters: [the sigmoid law](../force_law.md).",
    ),
    "sigmoid_lag": (
        r"F = F_l + k_g u + F_g \\ \tau \dot F_l = F_{\text{sigmoid}} - F_l \\"
        r" \tau = c_s \frac{f_t\,\tanh(\alpha x / 2)}{x}, \quad"
        r" x = v + v_h\,\operatorname{sgn}(a) + v_d",
        "$c_s$ is `compliance`, $k_g$ `stiffness`, $F_g$ `offset`; see "
        "[the extended law](../extended_law.md).",
    ),
}
"""Equation, and a sentence on what in it is not named as the parameters are."""
