"""What a reference station sends: RTCM 3 MSM7 at every epoch, 1006 and 1033 now and then, ephemerides in turn."""

from math import floor
from typing import Final

import numpy as np

from rtkmesh.codecs.rtcm3_encode import encode_ephemeris, encode_epoch, encode_glonass_bias, encode_station
from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation
from rtkmesh.simulation.receiver import Observed
from rtkmesh.simulation.schedule import EphemerisSchedule
from rtkmesh.simulation.sky import absolute_s, broadcast

_STATION_PERIOD_S: Final = 5.0
STATION_ID: Final = 42


class Rtcm3Stream:
    """Turns observed epochs into the bytes of one reference station at a known place."""

    def __init__(self, position_ecef_m: tuple[float, float, float], *, warm: bool, msm: int = 7) -> None:
        station = ReferenceStation(STATION_ID, position_ecef_m, 0.0, "ADVNULLANTENNA", "", "RTKMESH SIMULATOR")
        bias = GlonassBias(STATION_ID, True, (0.0, float("nan"), 0.0, float("nan")))
        self._station = b"".join((*encode_station(station), encode_glonass_bias(bias)))
        self._msm = msm
        self._schedule = EphemerisSchedule(warm=warm)
        self._station_turn = -1

    def encode(self, observed: Observed) -> bytes:
        """Return all bytes of an epoch."""
        epoch, parts = observed.epoch, list[bytes]()
        turn = floor(absolute_s(epoch.time) / _STATION_PERIOD_S + 1e-6)
        if turn != self._station_turn:
            self._station_turn = turn
            parts.append(self._station)
        parts += [
            encode_ephemeris(broadcast(satellite, epoch.time)) for satellite in self._schedule.due(np.unique(epoch.satellite), epoch.time)
        ]
        return b"".join((*parts, *encode_epoch(epoch, STATION_ID, self._msm)))
