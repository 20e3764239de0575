"""What a filter remembers of phases when the model of the ionosphere changes.

Coefficients come minutes after the start, and each day. Phases less their model then change by decimetres, those of both receivers alike:
their difference is as good as ever, but from epoch to epoch a receiver would seem to have moved.
"""

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.constants import GPS_L1_HZ
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE, SIGNALS_PER_SATELLITE, carrier_hz
from rtkmesh.models.geometry import GEOMETRY, IONOSPHERE_L1_M, receiver_geometry
from rtkmesh.models.single import Located
from rtkmesh.rtk.state import BASE_M, ROVER_M, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@kernel
def change_ionosphere(
    f: Filter, located: Located, channel: NDArray[np.int8], time: tuple[int, float], places_ecef_m: tuple[Vector, Vector], old: Vector,
    new: Vector,
) -> None:  # fmt: skip
    """Let the phases that are remembered be less the model of these Klobuchar coefficients (``new``) in place of the ``old`` ones.

    ``time`` is week and time of week (s) of ``located``; it is an epoch later, in which a model's delay changes by tenths of millimetres.
    ``channel`` is that of GLONASS satellites by number, the places are those of rover and base.
    """
    rover_m, base_m = _change_m(located, time, places_ecef_m[0], old, new), _change_m(located, time, places_ecef_m[1], old, new)
    for row in range(len(f.keys)):
        satellite = int(f.keys[row]) // KEYS_PER_SATELLITE
        place = int(np.searchsorted(located.satellites, satellite))
        if satellite == 0 or place == len(located.satellites) or located.satellites[place] != satellite:
            continue
        hz = carrier_hz(satellite, int(f.keys[row]) // SIGNALS_PER_SATELLITE % SIGNALS_PER_SATELLITE, int(channel[satellite]))
        if hz > 0.0 and isfinite(rover_m[place]) and isfinite(base_m[place]):
            f.history[row, ROVER_M] += rover_m[place] * (GPS_L1_HZ / hz) ** 2
            f.history[row, BASE_M] += base_m[place] * (GPS_L1_HZ / hz) ** 2


@kernel
def _change_m(located: Located, time: tuple[int, float], place_ecef_m: Vector, old: Vector, new: Vector) -> Vector:
    """Return by how much the delay at L1 (m) of each satellite changes at a place; NaN where it is not known."""
    before, after = np.empty((len(located.states), GEOMETRY)), np.empty((len(located.states), GEOMETRY))
    receiver_geometry(located.states, time[0], time[1], place_ecef_m, old, before)
    receiver_geometry(located.states, time[0], time[1], place_ecef_m, new, after)
    return after[:, IONOSPHERE_L1_M] - before[:, IONOSPHERE_L1_M]
