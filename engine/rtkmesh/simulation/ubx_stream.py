"""What a u-blox rover sends: RXM-RAWX and NAV-PVT at every epoch, RXM-SFRBX as satellites broadcast."""

from math import floor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.ubx_encode import encode_ephemeris, encode_ionosphere, encode_nav_pvt, encode_rawx
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.frames import enu_from_ecef, geodetic_from_ecef
from rtkmesh.gnss.signals import GLONASS, GPS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s
from rtkmesh.simulation.receiver import Observed
from rtkmesh.simulation.schedule import FRAME_S, EphemerisSchedule
from rtkmesh.simulation.sky import KLOBUCHAR, absolute_s, broadcast

Vector = NDArray[np.float64]

_FIX_ERROR_M: Final = 0.8  # of the receiver's own solution, a slow wander
_VELOCITY_ERROR_MPS: Final = 0.03


class UbxStream:
    """Turns observed epochs into the bytes of one receiver."""

    def __init__(self, seed: int, *, warm: bool) -> None:
        self._schedule = EphemerisSchedule(warm=warm)
        self._phases = np.random.default_rng((seed, 4711)).uniform(0.0, 2.0 * np.pi, 3)

    def encode(self, observed: Observed) -> bytes:
        """Return all bytes of an epoch."""
        epoch = observed.epoch
        raw = encode_rawx(epoch, clock_reset=observed.clock_reset, half_cycle_subtracted=observed.half_cycle_subtracted)
        parts = [raw, encode_nav_pvt(self._fix(observed))]
        for satellite in self._schedule.due(epoch.satellite, observed.true_time):
            sent = frame_start(satellite, observed.true_time)
            parts += encode_ephemeris(broadcast(satellite, observed.true_time), sent, KLOBUCHAR)
            if satellite // SATELLITES_PER_SYSTEM == GPS:
                parts.append(encode_ionosphere(satellite, KLOBUCHAR, sent))
        return b"".join(parts)

    def _fix(self, observed: Observed) -> ReceiverFix:
        """Return the receiver's own solution: the truth with a wandering error of about a metre."""
        time_s = absolute_s(observed.true_time)
        satellites = len(np.unique(observed.epoch.satellite))
        latitude, longitude, _ = geodetic_from_ecef(observed.position_ecef_m)
        turn = enu_from_ecef(latitude, longitude)
        wander = np.sin(2.0 * np.pi * time_s / np.array((70.0, 110.0, 150.0)) + self._phases)
        place = geodetic_from_ecef(observed.position_ecef_m + turn.T @ (_FIX_ERROR_M * wander))
        east, north, up = (turn @ observed.velocity_ecef_mps + _VELOCITY_ERROR_MPS * wander).tolist()
        time = _rounded_ms(observed.epoch.time)
        fix = 3 if satellites >= 5 else 0
        return ReceiverFix(time, fix, place[0], place[1], place[2], 1.2, 1.8, (north, east, -up), satellites)


def frame_start(satellite: int, time: GpsTime) -> GpsTime:
    """Return the start of the last whole navigation frame of a satellite before a time (GLONASS frames follow UTC)."""
    shift_s = gps_minus_utc_s(time) if satellite // SATELLITES_PER_SYSTEM == GLONASS else 0
    frames = floor((time.tow_s - shift_s) / FRAME_S) - 1
    return GpsTime.normalized(time.week, frames * FRAME_S + shift_s)


def _rounded_ms(time: GpsTime) -> GpsTime:
    return GpsTime.normalized(time.week, round(time.tow_s * 1e3) * 1e-3)
