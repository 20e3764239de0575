"""GLONASS satellite motion: integration of the broadcast state vector (GLONASS ICD 5.1, appendix 3.1.2)."""

from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.gnss.constants import J2_GLONASS, MU_GLONASS_M3_S2, OMEGA_EARTH_GLONASS_RADPS, RADIUS_GLONASS_M

STEP_S: Final = 60.0  # local error far below 1 mm; the broadcast force model is good to metres

Vector = NDArray[np.float64]
Six = tuple[float, float, float, float, float, float]

_OMEGA = OMEGA_EARTH_GLONASS_RADPS
_OMEGA2 = OMEGA_EARTH_GLONASS_RADPS**2
_C20 = 1.5 * J2_GLONASS * MU_GLONASS_M3_S2 * RADIUS_GLONASS_M**2


@kernel_in_place
def propagate_state(state: Vector, acceleration: Vector, seconds: float) -> int:
    """Move a state (position m and velocity m/s, PZ-90, 6) in place by ``seconds``; return the number of steps.

    Classical Runge-Kutta of fourth order in the rotating frame; ``acceleration`` (m/s2, 3) is the broadcast luni-solar part.
    """
    steps = int(np.ceil(abs(seconds) / STEP_S))
    if steps == 0:
        return 0
    h = seconds / steps
    for _ in range(steps):
        now = (state[0], state[1], state[2], state[3], state[4], state[5])
        first = _derivative(now, acceleration)
        second = _derivative(_ahead(now, first, 0.5 * h), acceleration)
        third = _derivative(_ahead(now, second, 0.5 * h), acceleration)
        fourth = _derivative(_ahead(now, third, h), acceleration)
        for k in range(6):
            state[k] += h / 6.0 * (first[k] + 2.0 * second[k] + 2.0 * third[k] + fourth[k])
    return steps


@kernel_in_place
def _ahead(state: Six, rate: Six, seconds: float) -> Six:
    """Return where a constant rate leads."""
    x, y, z = state[0] + seconds * rate[0], state[1] + seconds * rate[1], state[2] + seconds * rate[2]
    return x, y, z, state[3] + seconds * rate[3], state[4] + seconds * rate[4], state[5] + seconds * rate[5]


@kernel_in_place
def _derivative(state: Six, acceleration: Vector) -> Six:
    """Return the time derivative of a state: the simplified equations of motion of the ICD, appendix 3.1.2."""
    x, y, z, vx, vy, vz = state
    r2 = x * x + y * y + z * z
    r3 = r2 * sqrt(r2)
    a = _C20 / (r2 * r3)
    b = 5.0 * z * z / r2
    c = -MU_GLONASS_M3_S2 / r3
    ax = (c - a * (1.0 - b) + _OMEGA2) * x + 2.0 * _OMEGA * vy + acceleration[0]
    ay = (c - a * (1.0 - b) + _OMEGA2) * y - 2.0 * _OMEGA * vx + acceleration[1]
    az = (c - a * (3.0 - b)) * z + acceleration[2]
    return vx, vy, vz, ax, ay, az
