"""The branch of the hysteresis where the motion turns, without a jump.

The law shifts the velocity by sgn(a) v_h: the force jumps from one branch to the other within a
sample where the acceleration changes its sign, and back and forth where that is lost in noise.
Recorded forces do not. Along a branch of negative v_h the law's velocity v + sgn(a) v_h is that of
a body with a play of -v_h behind v; so it is here also where the motion turns: the shift follows
the velocity (a play operator; Visintin, Differential Models of Hysteresis, 1994),

    s[k] = clip(s[k-1] + (v[k] - v[k-1]) / |v_h|, -1, 1)    in the place of sgn(a).

It depends on the path of the velocity, not on its rate, and is the law once the velocity has come
back by 2 |v_h|. It needs no parameter.
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.models.force_model import State
from mr_damper_ros.signals.arrays import Array

REVERSAL_MEMORY = 2
"""Arrays of the state: the last velocity [m/s] and the last branch."""

NARROWEST = 1e-9
"""A play [m/s] that is narrower is none."""


def branch_along(
    velocity: Array, acceleration: Array, half_width: Array, before: State | None
) -> tuple[Array, State]:
    """The branch s (..., n), -1 to 1, along a velocity (n,), and the state after it.

    ``half_width`` (..., n) [m/s] is v_h, of either sign; ``before`` the state after the sample
    before. It starts on the branch of the acceleration (n,).
    """
    shape = np.broadcast_shapes(half_width.shape, velocity.shape)
    if before is None:
        last = velocity[0]
        branch = np.broadcast_to(np.sign(acceleration[0]), shape[:-1])
    else:
        last, branch = before[0].flat[0], before[1]
    changes = np.diff(velocity, prepend=last)
    steps = np.broadcast_to(changes / np.maximum(np.abs(half_width), NARROWEST), shape)
    rising = changes >= 0.0
    found = np.empty(shape)
    # Up to where the velocity turns it goes one way only.
    ends = [*(np.flatnonzero(rising[1:] != rising[:-1]) + 1).tolist(), velocity.size]
    first = 0
    for end in ends:
        stretch = branch[..., np.newaxis] + np.cumsum(steps[..., first:end], axis=-1)
        found[..., first:end] = (
            np.minimum(stretch, 1.0) if rising[first] else np.maximum(stretch, -1.0)
        )
        branch, first = found[..., end - 1], end
    return found, (np.full(shape[:-1], velocity[-1]), branch)
