"""A simulated receiver's own solution."""

from typing import Final

import numpy as np

from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.frames import enu_from_ecef, geodetic_from_ecef
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.receiver import Observed
from rtkmesh.simulation.sky import absolute_s

_FIX_ERROR_M: Final = 0.8  # a slow wander
_VELOCITY_ERROR_MPS: Final = 0.03


class OwnFix:
    """Makes the receiver's own solutions: the truth with a wandering error of about a metre."""

    def __init__(self, seed: int) -> None:
        self._phases = np.random.default_rng((seed, 4711)).uniform(0.0, 2.0 * np.pi, 3)

    def __call__(self, observed: Observed) -> ReceiverFix:
        """Return the solution of an epoch."""
        time_s = absolute_s(observed.true_time)
        satellites = len(np.unique(observed.epoch.satellite))
        latitude, longitude, _ = geodetic_from_ecef(observed.position_ecef_m)
        turn = enu_from_ecef(latitude, longitude)
        wander = np.sin(2.0 * np.pi * time_s / np.array((70.0, 110.0, 150.0)) + self._phases)
        place = geodetic_from_ecef(observed.position_ecef_m + turn.T @ (_FIX_ERROR_M * wander))
        east, north, up = (turn @ observed.velocity_ecef_mps + _VELOCITY_ERROR_MPS * wander).tolist()
        fix = 3 if satellites >= 5 else 0
        return ReceiverFix(rounded_ms(observed.epoch.time), fix, place[0], place[1], place[2], 1.2, 1.8, (north, east, -up), satellites)


def rounded_ms(time: GpsTime) -> GpsTime:
    """Return the time to the millisecond that receivers tell."""
    return GpsTime.normalized(time.week, round(time.tow_s * 1e3) * 1e-3)
