"""UBX messages to values: RXM-RAWX, RXM-SFRBX and NAV-PVT (u-blox F9 HPG 1.32 interface description, 3.17 and 3.15).

All other messages are counted as ignored; the services read what they need of them with pyubx2.
"""

from datetime import UTC, datetime
from math import isfinite, radians
from struct import Struct, unpack_from
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.messages import DecodingCounters, Frame, Message
from rtkmesh.codecs.navigation import NavigationData, NavigationDecoder, Refusal
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import (
    BEIDOU,
    GALILEO,
    GLONASS,
    GPS,
    NAVIC,
    NO_CHANNEL,
    QZSS,
    SATELLITES_PER_SYSTEM,
    SBAS,
    signal_number,
)  # fmt: skip
from rtkmesh.gnss.time import GpsTime, nearest_week

RAWX, SFRBX, NAV_PVT = "02-15", "02-13", "01-07"

# gnssId -> (system, first svId, last svId, svId - number); (gnssId, sigId) -> RINEX code (interface description 1.5)
_SATELLITES: Final = {
    0: (GPS, 1, 32, 0), 1: (SBAS, 120, 158, 100), 2: (GALILEO, 1, 36, 0), 3: (BEIDOU, 1, 63, 0), 5: (QZSS, 1, 10, 0),
    6: (GLONASS, 1, 32, 0), 7: (NAVIC, 1, 14, 0),
}  # fmt: skip
_SIGNALS: Final = {
    (0, 0): "1C", (0, 3): "2L", (0, 4): "2S", (0, 6): "5I", (0, 7): "5Q",
    (1, 0): "1C",
    (2, 0): "1C", (2, 1): "1B", (2, 3): "5I", (2, 4): "5Q", (2, 5): "7I", (2, 6): "7Q", (2, 8): "6B", (2, 9): "6C", (2, 10): "6A",
    (3, 0): "2I", (3, 1): "2I", (3, 2): "7I", (3, 3): "7I", (3, 4): "6I", (3, 10): "6I",
    (3, 5): "1P", (3, 6): "1D", (3, 7): "5P", (3, 8): "5D",
    (5, 0): "1C", (5, 1): "1Z", (5, 4): "2S", (5, 5): "2L", (5, 8): "5I", (5, 9): "5Q", (5, 12): "1E",
    (6, 0): "1C", (6, 2): "2C",
    (7, 0): "5A",
}  # fmt: skip
_GNSS_IDS, _SV_IDS, _SIG_IDS, _GLONASS_ID = 8, 256, 16, 6


def _satellite_table() -> NDArray[np.int16]:
    """Return satellite numbers by gnssId and svId, 0 where there is none."""
    table = np.zeros((_GNSS_IDS, _SV_IDS), np.int16)
    for gnss, (system, first, last, offset) in _SATELLITES.items():
        for sv in range(first, last + 1):
            table[gnss, sv] = system * SATELLITES_PER_SYSTEM + sv - offset
    return table


def _signal_table() -> NDArray[np.int16]:
    """Return signal numbers by gnssId and sigId, 0 where there is none."""
    table = np.zeros((_GNSS_IDS, _SIG_IDS), np.int16)
    for (gnss, sig), code in _SIGNALS.items():
        table[gnss, sig] = signal_number(code)
    return table


_SATELLITE_OF = _satellite_table()
_SIGNAL_OF = _signal_table()

_RAWX_HEADER: Final = Struct("<dHbBBB2x")
_PAYLOAD, _ROWS, _ROW_BYTES = 6, 22, 32  # offsets in a frame of the payload and of the measurements, and their size

_PSEUDORANGE_VALID, _PHASE_VALID, _HALF_CYCLE_VALID = 1, 2, 4  # trkStat; 8: half cycle subtracted from the phase
_MAX_LOCK_MS = 64500  # locktime counts no further
_MAX_PSEUDORANGE_M, _MAX_PHASE_CYC, _MAX_DOPPLER_HZ = 1e9, 1e10, 1e6  # before the first fix the receiver's clock may be anything

Columns = tuple[NDArray[np.int16], NDArray[np.int16], NDArray[np.int8], NDArray[np.uint8], NDArray[np.float64], int]


@kernel
def rawx_slip(state: NDArray[np.float64], lock_ms: int, track: int, time_s: float) -> bool:
    """Return whether the phase slipped since this signal's last valid phase, and remember this epoch.

    ``state``: time of the last epoch (s, negative: none), its lock time (ms), whether the half cycle was subtracted in it, whether a
    slip waits to be told. The lock time fell or is shorter than the time since then, or the subtraction of the half cycle changed. A
    slip that meets no valid phase waits for one.
    """
    subtracted, slipped = track >> 3 & 1, lock_ms == 0
    if state[0] >= 0.0:
        too_short = lock_ms < _MAX_LOCK_MS and lock_ms / 1e3 + 0.1 < time_s - state[0]
        slipped = slipped or lock_ms < state[1] or too_short or subtracted != state[2] or state[3] > 0.0
    state[0], state[1], state[2] = time_s, lock_ms, subtracted
    state[3] = 1.0 if slipped and not track & _PHASE_VALID else 0.0
    return slipped


@kernel
def rawx_order(octets: NDArray[np.uint8], version: int, order: NDArray[np.int64], keys: NDArray[np.int64]) -> int:
    """Fill the row numbers of known signals and their keys (satellite * 512 + signal), rising, each key once; return how many."""
    count = 0
    for i in range(len(order)):
        gnss, sv, sig = int(octets[32 * i + 20]), int(octets[32 * i + 21]), int(octets[32 * i + 22]) if version > 0 else 0
        if gnss >= _GNSS_IDS or sig >= _SIG_IDS or _SATELLITE_OF[gnss, sv] == 0 or _SIGNAL_OF[gnss, sig] == 0:
            continue
        key = int(_SATELLITE_OF[gnss, sv]) * 512 + int(_SIGNAL_OF[gnss, sig])
        place = count
        while place > 0 and keys[place - 1] > key:
            place -= 1
        if place > 0 and keys[place - 1] == key:
            continue
        for k in range(count, place, -1):
            keys[k], order[k] = keys[k - 1], order[k - 1]
        keys[place], order[place] = key, i
        count += 1
    return count


@kernel
def rawx_columns(
    octets: NDArray[np.uint8],
    doubles: NDArray[np.float64],
    singles: NDArray[np.float32],
    version: int,
    time_s: float,
    state: NDArray[np.float64],
) -> Columns:
    """Return the columns of an epoch, sorted by (satellite, signal), of RXM-RAWX measurements.

    The measurements (32 bytes each) come as three views of the same bytes; ``state`` is that of ``rawx_slip`` by gnssId, svId, sigId. The
    float columns are the rows of one array: pseudorange, phase, Doppler, C/N0, lock time, sigma of pseudorange, of phase. The last
    value is the number of rows dropped: satellite or signal not known, or there twice.
    """
    total = len(octets) // 32
    order, keys = np.empty(total, np.int64), np.empty(total, np.int64)
    count = rawx_order(octets, version, order, keys)
    satellite, signal = np.empty(count, np.int16), np.empty(count, np.int16)
    channel, flags, values = np.empty(count, np.int8), np.zeros(count, np.uint8), np.empty((7, count))
    for k in range(count):
        satellite[k], signal[k] = keys[k] // 512, keys[k] % 512
        at = 32 * order[k]
        gnss, sv, sig, freq = int(octets[at + 20]), int(octets[at + 21]), int(octets[at + 22]) if version > 0 else 0, int(octets[at + 23])
        channel[k] = freq - 7 if gnss == _GLONASS_ID and freq <= 20 else NO_CHANNEL
        lock_ms, track = int(octets[at + 24]) | int(octets[at + 25]) << 8, int(octets[at + 30])
        pseudorange_m, phase_cyc, doppler_hz = doubles[at // 8], doubles[at // 8 + 1], float(singles[at // 4 + 4])
        code_valid = track & _PSEUDORANGE_VALID and 0.0 < pseudorange_m < _MAX_PSEUDORANGE_M
        phase_valid = track & _PHASE_VALID and abs(phase_cyc) < _MAX_PHASE_CYC
        slipped = rawx_slip(state[gnss, sv, sig], lock_ms, track, time_s)
        if phase_valid:
            flags[k] = (SLIP if slipped else 0) | (0 if track & _HALF_CYCLE_VALID else HALF_CYCLE)
        code_index, phase_index = int(octets[at + 27]) & 15, int(octets[at + 28]) & 15
        values[0, k] = pseudorange_m if code_valid else np.nan
        values[1, k] = phase_cyc if phase_valid else np.nan
        values[2, k] = doppler_hz if abs(doppler_hz) < _MAX_DOPPLER_HZ else np.nan
        values[3, k] = octets[at + 26]
        values[4, k] = lock_ms / 1e3
        values[5, k] = 0.01 * (1 << code_index)
        values[6, k] = 0.004 * phase_index if 0 < phase_index < 15 else np.nan
    return satellite, signal, channel, flags, values, total - count


_SFRBX_HEADER: Final = Struct("<BBBBBxxx")
_LNAV_SIGNALS: Final = {0: (0,), 5: (0,)}  # C/A only: the other signals carry CNAV or SBAS-like data
_INAV_SIGNALS: Final = (1, 5)
_D1_SIGNALS: Final = (0, 2, 4)
_D2_SIGNALS: Final = (0, 1, 3, 10)  # 0: receivers before the F9 do not tell D2 apart
_BEIDOU_GEO: Final = frozenset((1, 2, 3, 4, 5, 59, 60, 61, 62, 63))

_NAV_PVT: Final = Struct("<IHBBBBBBIiBBBBiiiiIIiii")


class UbxDecoder:
    """Decodes the UBX frames of one receiver; it remembers lock times and navigation blocks."""

    def __init__(self, approximate_time: GpsTime | None = None) -> None:
        self.counters = DecodingCounters()
        self.clock_resets = 0
        self._navigation = NavigationDecoder(approximate_time)
        self._slip_state = np.full((_GNSS_IDS, _SV_IDS, _SIG_IDS, 4), -1.0)

    @property
    def time(self) -> GpsTime | None:
        """The newest time of this stream, or what was told."""
        return self._navigation.time

    def decode(self, frame: Frame) -> list[Message]:
        """Return the messages of one UBX frame (ephemerides that its time settles come first)."""
        kind = frame.kind
        if kind == SFRBX:
            found = self._sfrbx(frame.data)
        elif kind == RAWX:
            found = self._rawx(frame.data)
        elif kind == NAV_PVT:
            found = self._nav_pvt(frame.data)
        else:
            self.counters.ignored[f"ubx/{kind}"] += 1
            return []
        if isinstance(found, str):
            self.counters.rejected[f"ubx/{kind} {found}"] += 1
            return []
        self.counters.decoded[f"ubx/{kind}"] += 1
        return found

    def _rawx(self, data: bytes) -> list[Message] | str:
        payload = len(data) - 8
        if payload < 16:
            return "length"
        tow_s, week, _, total, status, version = _RAWX_HEADER.unpack_from(data, _PAYLOAD)
        if payload < 16 + _ROW_BYTES * total:
            return "length"
        if not (isfinite(tow_s) and -1.0 < tow_s < SECONDS_PER_WEEK + 1.0) or week == 0:
            return "time"
        time = GpsTime.normalized(week, tow_s)
        rows = data[_ROWS : _ROWS + _ROW_BYTES * total]
        views = np.frombuffer(rows, np.uint8), np.frombuffer(rows, np.float64), np.frombuffer(rows, np.float32)
        now_s = time.week * SECONDS_PER_WEEK + time.tow_s
        satellite, signal, channel, flags, v, dropped = rawx_columns(*views, version, now_s, self._slip_state)
        if dropped:
            self.counters.rejected["ubx/02-15 unknown signal"] += dropped
        self.clock_resets += status >> 1 & 1
        self.counters.epochs += 1
        epoch = Epoch(time, satellite, signal, channel, flags, v[0], v[1], v[2], v[3], v[4], v[5], v[6])
        return [*self._navigation.set_time(time), epoch]

    def _sfrbx(self, data: bytes) -> list[Message] | str:
        payload = len(data) - 8
        if payload < 8:
            return "length"
        gnss, sv, sig, freq, words = _SFRBX_HEADER.unpack_from(data, _PAYLOAD)
        if payload < 8 + 4 * words:
            return "length"
        satellite = int(_SATELLITE_OF[gnss, sv]) if gnss < _GNSS_IDS else 0
        if not satellite:
            return "satellite"
        found = self._subframe(gnss, satellite, sig, freq, unpack_from(f"<{words}I", data, _PAYLOAD + 8))
        if isinstance(found, Refusal):
            return found.value
        return [*found]

    def _subframe(self, gnss: int, satellite: int, sig: int, freq: int, words: tuple[int, ...]) -> list[NavigationData] | Refusal:
        """Hand the words over as one block; messages that hold no ephemeris of ours give nothing."""
        navigation, count = self._navigation, len(words)
        if gnss in _LNAV_SIGNALS and sig in _LNAV_SIGNALS[gnss] and count == 10:
            return navigation.lnav(satellite, _block(words, 30))
        if gnss == 2 and sig in _INAV_SIGNALS and count >= 8:
            return navigation.inav(satellite, _block(words[:8], 32))
        if gnss == 3 and count == 10:
            if satellite % SATELLITES_PER_SYSTEM in _BEIDOU_GEO:
                return navigation.d2(satellite, _block(words, 30)) if sig in _D2_SIGNALS else []
            return navigation.d1(satellite, _block(words, 30)) if sig in _D1_SIGNALS else []
        if gnss == 6 and count == 4 and freq <= 20:
            return navigation.glonass(satellite, freq - 7, _block(words[:3], 32) >> 11, words[3])
        return []

    def _nav_pvt(self, data: bytes) -> list[Message] | str:
        if len(data) - 8 < _NAV_PVT.size:
            return "length"
        values = _NAV_PVT.unpack_from(data, _PAYLOAD)
        time = _pvt_time(values)
        fix = _receiver_fix(values, time)
        return [fix] if time is None else [*self._navigation.set_time(time), fix]


def _block(words: tuple[int, ...], bits: int) -> int:
    """Return the lowest ``bits`` bits of each word, joined."""
    block, mask = 0, (1 << bits) - 1
    for word in words:
        block = block << bits | word & mask
    return block


def _pvt_time(values: tuple[int, ...]) -> GpsTime | None:
    """Return the time of a NAV-PVT: its time of week in the week of its UTC date, if it says that date and time are valid."""
    tow_ms, year, month, day, hour, minute, second, valid = values[:8]
    if valid & 3 != 3 or not 0 <= tow_ms < SECONDS_PER_WEEK * 1000.0:
        return None
    try:
        utc = datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC)
    except ValueError:
        return None
    return nearest_week(tow_ms / 1e3, GpsTime.from_utc(utc))


def _receiver_fix(values: tuple[int, ...], time: GpsTime | None) -> ReceiverFix:
    fix_type, flags, _, satellites, lon, lat, height, _, horizontal, vertical, north, east, down = values[10:]
    fix = {1: 1, 2: 2, 3: 3, 4: 3}.get(fix_type, 0)
    if not flags & 1:  # outside the receiver's own limits
        fix = 0
    elif fix in (2, 3):
        fix = {1: 5, 2: 6}.get(flags >> 6, 4 if flags & 2 else fix)
    return ReceiverFix(
        time, fix, radians(lat * 1e-7), radians(lon * 1e-7), height / 1e3, horizontal / 1e3, vertical / 1e3,
        (north / 1e3, east / 1e3, down / 1e3), satellites,
    )  # fmt: skip
