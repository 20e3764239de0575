"""What a u-blox rover sends: RXM-RAWX and NAV-PVT at every epoch, RXM-SFRBX as satellites broadcast."""

from math import floor

from rtkmesh.codecs.ubx_encode import encode_ephemeris, encode_ionosphere, encode_nav_pvt, encode_rawx
from rtkmesh.gnss.signals import GLONASS, GPS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s
from rtkmesh.simulation.own_fix import OwnFix
from rtkmesh.simulation.receiver import Observed
from rtkmesh.simulation.schedule import FRAME_S, EphemerisSchedule
from rtkmesh.simulation.sky import KLOBUCHAR, broadcast


class UbxStream:
    """Turns observed epochs into the bytes of one receiver."""

    def __init__(self, seed: int, *, warm: bool) -> None:
        self._schedule = EphemerisSchedule(warm=warm)
        self._fix = OwnFix(seed)

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


def frame_start(satellite: int, time: GpsTime) -> GpsTime:
    """Return the start of the last whole navigation frame of a satellite before a time (GLONASS frames follow UTC)."""
    shift_s = gps_minus_utc_s(time) if satellite // SATELLITES_PER_SYSTEM == GLONASS else 0
    frames = floor((time.tow_s - shift_s) / FRAME_S) - 1
    return GpsTime.normalized(time.week, frames * FRAME_S + shift_s)
