"""GLONASS satellite motion: integration of the broadcast state vector (GLONASS ICD 5.1, appendix 3.1.2)."""

from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import arithmetic, kernel
from rtkmesh.gnss.constants import J2_GLONASS, MU_GLONASS_M3_S2, OMEGA_EARTH_GLONASS_RADPS, RADIUS_GLONASS_M

STEP_S: Final = 60.0  # local error far below 1 mm; the broadcast force model is good to metres

Vector = NDArray[np.float64]

_OMEGA = OMEGA_EARTH_GLONASS_RADPS
_OMEGA2 = OMEGA_EARTH_GLONASS_RADPS**2
_C20 = 1.5 * J2_GLONASS * MU_GLONASS_M3_S2 * RADIUS_GLONASS_M**2


@kernel
def propagate_state(state: Vector, acceleration: Vector, seconds: float) -> int:
    """Move a state (position m and velocity m/s, PZ-90, 6) in place by ``seconds``; return the number of steps.

    Classical Runge-Kutta of fourth order in the rotating frame; ``acceleration`` (m/s2, 3) is the broadcast luni-solar part.
    """
    steps = int(np.ceil(abs(seconds) / STEP_S))
    if steps == 0:
        return 0
    h = seconds / steps
    rate, total, trial = np.empty(6), np.empty(6), np.empty(6)
    for _ in range(steps):
        _derivative(state, acceleration, total)
        for k in range(6):
            trial[k] = state[k] + 0.5 * h * total[k]
        for stage in range(1, 4):
            _derivative(trial, acceleration, rate)
            weight = 1.0 if stage == 3 else 2.0
            ahead = h if stage == 2 else 0.5 * h
            for k in range(6):
                total[k] += weight * rate[k]
                trial[k] = state[k] + ahead * rate[k]
        for k in range(6):
            state[k] += h / 6.0 * total[k]
    return steps


@arithmetic
def _derivative(state: Vector, acceleration: Vector, out: Vector) -> None:
    """Write the time derivative of a state: the simplified equations of motion of the ICD, appendix 3.1.2."""
    x, y, z, vx, vy = state[0], state[1], state[2], state[3], state[4]
    r2 = x * x + y * y + z * z
    r3 = r2 * sqrt(r2)
    a = _C20 / (r2 * r3)
    b = 5.0 * z * z / r2
    c = -MU_GLONASS_M3_S2 / r3
    out[0], out[1], out[2] = vx, vy, state[5]
    out[3] = (c - a * (1.0 - b) + _OMEGA2) * x + 2.0 * _OMEGA * vy + acceleration[0]
    out[4] = (c - a * (1.0 - b) + _OMEGA2) * y - 2.0 * _OMEGA * vx + acceleration[1]
    out[5] = (c - a * (3.0 - b)) * z + acceleration[2]
