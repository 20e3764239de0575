"""UBX messages to values: RXM-RAWX, RXM-SFRBX, NAV-PVT (u-blox F9 HPG 1.32 interface description, 3.17 and 3.15) and those of
``ubx_receiver``.

All other messages are counted as ignored.
"""

from collections.abc import Sequence
from math import isfinite, radians
from struct import Struct
from typing import Final

import numpy as np

from rtkmesh.codecs.messages import DecodingCounters, Frame, Message
from rtkmesh.codecs.navigation import NavigationDecoder
from rtkmesh.codecs.navigation_words import QUIET, REFUSALS
from rtkmesh.codecs.ubx_observations import MEASUREMENT, ROW_BYTES, new_slip_state, rawx_columns
from rtkmesh.codecs.ubx_receiver import READERS, read_report
from rtkmesh.codecs.ubx_subframes import UNKNOWN_SATELLITE, WRONG_LENGTH, take_subframes
from rtkmesh.codecs.utc import from_utc, gps_day
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime, nearest_week

RAWX, SFRBX, NAV_PVT = "02-15", "02-13", "01-07"

_PAYLOAD, _ROWS = 6, 22  # offsets in a frame of the payload and of the measurements
_RAWX_HEADER: Final = Struct("<dHbBBB2x")
_NAV_PVT: Final = Struct("<IHBBBBBBIiBBBBiiiiIIiii")
_SFRBX_LABEL: Final = f"ubx/{SFRBX}"
_REASONS: Final = {WRONG_LENGTH: "length", UNKNOWN_SATELLITE: "satellite", **{code: reason.value for code, reason in REFUSALS.items()}}


class UbxDecoder:
    """Decodes the UBX frames of one receiver; it remembers lock times and navigation blocks. ``repeats``: see NavigationDecoder."""

    def __init__(self, approximate_time: GpsTime | None = None, *, repeats: bool = False) -> None:
        self.counters = DecodingCounters()
        self.clock_resets = 0
        self._navigation = NavigationDecoder(approximate_time, repeats=repeats)
        self._slip_state = new_slip_state()

    @property
    def time(self) -> GpsTime | None:
        """The newest time of this stream, or what was told."""
        return self._navigation.time

    def decode(self, frame: Frame) -> list[Message]:
        """Return the messages of one UBX frame (ephemerides that its time settles come first)."""
        kind = frame.kind
        if kind == SFRBX:
            return self.decode_subframes((frame,))[0]
        if kind == RAWX:
            found = self._rawx(frame.data)
        elif kind == NAV_PVT:
            found = self._nav_pvt(frame.data)
        elif kind in READERS:
            found = self._report(kind, frame.data)
        else:
            self.counters.ignored[f"ubx/{kind}"] += 1
            return []
        if isinstance(found, str):
            self.counters.rejected[f"ubx/{kind} {found}"] += 1
            return []
        self.counters.decoded[f"ubx/{kind}"] += 1
        return found

    def decode_subframes(self, frames: Sequence[Frame]) -> list[list[Message]]:
        """Return the messages of each of these RXM-SFRBX frames, which follow one another."""
        data, position, refused = b"".join([frame.data for frame in frames]), 0, 0
        navigation = self._navigation
        found: list[list[Message]] = []
        while position < len(data):
            taken, position, satellite, message, result = take_subframes(data, position, navigation.satellites, *navigation.now)
            found += [[] for _ in range(taken)]
            if result == QUIET:
                break
            if result >= 0:
                found[-1] += navigation.look(satellite, message, result)
            else:
                self.counters.rejected[f"ubx/{SFRBX} {_REASONS[result]}"] += 1
                refused += 1
        if len(found) > refused:
            self.counters.decoded[_SFRBX_LABEL] += len(found) - refused
        return found

    def _rawx(self, data: bytes) -> list[Message] | str:
        payload = len(data) - 8
        if payload < 16:
            return "length"
        tow_s, week, _, total, status, version = _RAWX_HEADER.unpack_from(data, _PAYLOAD)
        if payload < 16 + ROW_BYTES * total:
            return "length"
        if not (isfinite(tow_s) and -1.0 < tow_s < SECONDS_PER_WEEK + 1.0) or week == 0:
            return "time"
        time = GpsTime(week, tow_s) if 0.0 <= tow_s < SECONDS_PER_WEEK else GpsTime.normalized(week, tow_s)
        rows = np.frombuffer(data, MEASUREMENT, total, _ROWS)
        ids, channel, flags, columns = (
            np.empty((2, total), np.int16),
            np.empty(total, np.int8),
            np.empty(total, np.uint8),
            np.empty((7, total)),
        )
        now_s = time.week * SECONDS_PER_WEEK + time.tow_s
        count = rawx_columns(rows, version, now_s, self._slip_state, ids, channel, flags, columns)
        if count < total:
            self.counters.rejected["ubx/02-15 unknown signal"] += total - count
            ids, channel, flags, columns = ids[:, :count], channel[:count], flags[:count], columns[:, :count]
        self.clock_resets += status >> 1 & 1
        self.counters.epochs += 1
        v = columns
        epoch = Epoch(time, ids[0], ids[1], channel, flags, v[0], v[1], v[2], v[3], v[4], v[5], v[6])
        return [*self._navigation.set_time(time), epoch]

    def _report(self, kind: str, data: bytes) -> list[Message] | str:
        report = read_report(kind, data[_PAYLOAD:-2], self.time)
        return report if isinstance(report, str) else [report]

    def _nav_pvt(self, data: bytes) -> list[Message] | str:
        if len(data) - 8 < _NAV_PVT.size:
            return "length"
        values = _NAV_PVT.unpack_from(data, _PAYLOAD)
        time = _pvt_time(values)
        fix = _receiver_fix(values, time)
        return [fix] if time is None else [*self._navigation.set_time(time), fix]


def _pvt_time(values: tuple[int, ...]) -> GpsTime | None:
    """Return the time of a NAV-PVT: its time of week in the week of its UTC date, if it says that date and time are valid."""
    tow_ms, year, month, day, hour, minute, second, valid = values[:8]
    if valid & 3 != 3 or not 0 <= tow_ms < SECONDS_PER_WEEK * 1000.0:
        return None
    if hour > 23 or minute > 59:
        return None
    try:
        near = from_utc(gps_day(year, month, day), (hour * 3600 + minute * 60 + min(second, 59)) * 1_000_000)
    except ValueError:
        return None
    return nearest_week(tow_ms / 1e3, near)


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
