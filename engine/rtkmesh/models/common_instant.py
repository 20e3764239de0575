"""The epochs of two moving receivers, brought to one instant.

A receiver measures when its own clock says so, and that is off by up to a millisecond (u-blox steps its clock by whole ones). At 10 m/s
one antenna is then a centimetre further on than when the other was measured, and no integer search sees it: the baseline is off by
velocity times the difference of the clocks. Single points know both, the clocks to 10 ns and the velocities to 0.1 m/s: 0.1 mm.
"""

from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import Signals
from rtkmesh.gnss.signals import NO_CHANNEL, carrier_hz
from rtkmesh.models.geometry import E_X, E_Y, E_Z
from rtkmesh.models.single import Located

Vector = NDArray[np.float64]

_LARGEST_M: Final = 20.0  # of a base that moves on: beyond this a clock or a velocity is not what it says


def base_move_ecef_m(rover: Located, base: Located, ahead_s: float) -> Vector:
    """Return by how much (m, ECEF) a base must be moved for the baseline to be that of the instant that the rover's tag names.

    ``ahead_s``: the rover's tag minus the base's. Zero where a clock or a velocity is not known, and where it would be absurd.
    """
    at_base = (ahead_s + base.clock_s) * base.velocity_mps[:3]
    move = at_base - rover.clock_s * rover.velocity_mps[:3]
    size_m = float(np.abs(move).max())
    return move if isfinite(size_m) and size_m <= _LARGEST_M else np.zeros(3)


@kernel
def moved_base(signals: Signals, base: Located, channels: NDArray[np.int8], move_ecef_m: Vector) -> tuple[Vector, Vector]:
    """Return the codes (m) and phases (cycles) that a base would have measured had it been ``move_ecef_m`` further.

    ``channels``: of GLONASS, per satellite number, for rows without one. Satellites without a direction stay as they are.
    """
    codes_m, phases_cyc, k = signals.pseudorange_m.copy(), signals.phase_cyc.copy(), 0
    for i in range(len(codes_m)):
        satellite = int(signals.satellite[i])
        while k < len(base.satellites) and base.satellites[k] < satellite:
            k += 1
        if k == len(base.satellites) or base.satellites[k] != satellite:
            continue
        g = base.geometry[k]
        nearer_m = g[E_X] * move_ecef_m[0] + g[E_Y] * move_ecef_m[1] + g[E_Z] * move_ecef_m[2]
        own = int(signals.channel[i])
        hz = carrier_hz(satellite, int(signals.signal[i]), own if own != NO_CHANNEL else int(channels[satellite]))
        codes_m[i] -= nearer_m
        phases_cyc[i] -= nearer_m * hz / SPEED_OF_LIGHT_MPS
    return codes_m, phases_cyc
