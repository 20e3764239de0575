"""SBF blocks of Septentrio receivers to values (mosaic-X5 reference guide 4.14, 4.1 and 4.2).

Measurements (MeasEpoch with MeasExtra), navigation data raw and decoded, the receiver's own solution and attitude, its set-up. All other
blocks are counted as ignored. Of Meas3 the manufacturer publishes no definition.
"""

from dataclasses import replace
from struct import Struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs import sbf_ephemerides, sbf_navigation
from rtkmesh.codecs.messages import DecodingCounters, Frame, Message, Protocol
from rtkmesh.codecs.navigation import NavigationDecoder
from rtkmesh.codecs.navigation_words import Refusal
from rtkmesh.codecs.sbf_observations import HEAD, ROW, SCRAMBLED, add_extra, epoch_columns, new_slip_state, read_signals
from rtkmesh.codecs.sbf_solution import ATTITUDE, PVT_GEODETIC, RECEIVER_SETUP, AttitudeReader, StationReader, read_fix
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime

MEAS_EPOCH, MEAS_EXTRA, END_OF_MEAS = "4027", "4000", "5922"

_TIME: Final = Struct("<IH")
_TIME_OFFSET, _SHORTEST_ROW = 8, 12
_NO_WEEK: Final = 65535
_WEEK_MS: Final = SECONDS_PER_WEEK * 1e3


class SbfDecoder:
    """Decodes the SBF blocks of one receiver; it remembers lock times and navigation blocks.

    ``antenna``: 0 main, 1 and 2 the auxiliary ones of a receiver with several, whose measurements come in the same block. In a stream
    with MeasExtra an epoch waits for it, until another block comes. ``repeats``: see NavigationDecoder.
    """

    def __init__(self, approximate_time: GpsTime | None = None, antenna: int = 0, *, repeats: bool = False) -> None:
        self.counters = DecodingCounters()
        self.clock_resets = 0
        self._antenna = antenna
        self._navigation = NavigationDecoder(approximate_time, repeats=repeats)
        self._slip_state = new_slip_state()
        self._jumps: int | None = None
        self._held: tuple[Epoch, NDArray[np.int64]] | None = None  # an epoch that waits, and what its rows are called there
        self._last: Epoch | None = None
        self._extra_comes = False
        self._attitude = AttitudeReader()
        self._station = StationReader()

    @property
    def time(self) -> GpsTime | None:
        """The newest time of this stream, or what was told."""
        return self._navigation.time

    def decode(self, frame: Frame) -> list[Message]:
        """Return the messages of one block, and what waited for it."""
        if frame.kind == MEAS_EXTRA:
            return self._count(frame.kind, self._meas_extra(frame.data))
        waited = self._flush_epoch() if frame.kind in ATTITUDE else self.flush()
        time = _time_of(frame.data)
        settled: list[Message] = [] if time is None else [*self._navigation.set_time(time)]
        return waited + settled + self._count(frame.kind, self._read(frame, time))

    def flush(self) -> list[Message]:
        """Return the epoch that still waits for its MeasExtra, and the heading that waits for its sigmas."""
        return [*self._flush_epoch(), *self._attitude.flush()]

    def _flush_epoch(self) -> list[Message]:
        if self._held is None:
            return []
        (epoch, _), self._held = self._held, None
        self._extra_comes = False
        return [epoch]

    def _count(self, kind: str, found: list[Message] | str | None) -> list[Message]:
        """Count a block: decoded, rejected (a reason) or ignored (None)."""
        if found is None:
            self.counters.ignore(Protocol.SBF, kind)
        elif isinstance(found, str):
            self.counters.rejected[f"sbf/{kind} {found}"] += 1
        else:
            self.counters.decoded[f"sbf/{kind}"] += 1
        return found if isinstance(found, list) else []

    def _read(self, frame: Frame, time: GpsTime | None) -> list[Message] | str | None:
        kind, data = frame.kind, frame.data
        if kind == MEAS_EPOCH:
            return "time" if time is None else self._meas_epoch(data, time)
        if kind in sbf_navigation.NUMBERS:
            return self._raw_navigation(data, kind, time)
        if kind in sbf_ephemerides.NUMBERS:
            return "time" if time is None else _one(sbf_ephemerides.read_navigation(data, kind, time))
        if kind in ATTITUDE:
            found = self._attitude.take(kind, data, time)
            return found if isinstance(found, str) else [*found]
        if kind == RECEIVER_SETUP:
            return _one(self._station.setup(data))
        if kind == PVT_GEODETIC:
            return self._solution(data, time)
        return [] if kind == END_OF_MEAS else None

    def _solution(self, data: bytes, time: GpsTime | None) -> list[Message] | str:
        fix = read_fix(data, time)
        if isinstance(fix, str):
            return fix
        station = self._station.fixed(data, fix)
        return [fix] if station is None else [station, fix]

    def _raw_navigation(self, data: bytes, kind: str, time: GpsTime | None) -> list[Message] | str:
        block = sbf_navigation.read_block(data, kind, time)
        if block is None or isinstance(block, str):
            return [] if block is None else block
        found = self._navigation.take(*block)
        return found.value if isinstance(found, Refusal) else [*found]

    def _meas_epoch(self, data: bytes, time: GpsTime) -> list[Message] | str:
        if len(data) < HEAD:
            return "length"
        rows = np.zeros((len(data) - HEAD) // _SHORTEST_ROW + 1, ROW)
        total = read_signals(data, len(data), rows)
        if total < 0:
            return "scrambled" if total == SCRAMBLED else "length"
        self._count_jumps(data[18])
        epoch, sources = self._epoch(rows[:total], time)
        self.counters.epochs += 1
        if not self._extra_comes:
            self._last = epoch
            return [epoch]
        self._held = epoch, sources
        return []

    def _epoch(self, rows: NDArray[np.void], time: GpsTime) -> tuple[Epoch, NDArray[np.int64]]:
        total = len(rows)
        ids, sources, columns = np.empty((2, total), np.int16), np.empty((2, total), np.int64), np.empty((7, total))
        channel, flags = np.empty(total, np.int8), np.empty(total, np.uint8)
        now_s = time.week * SECONDS_PER_WEEK + time.tow_s
        count, unknown = epoch_columns(rows, self._antenna, now_s, self._slip_state, ids, sources, channel, flags, columns)
        if unknown:
            self.counters.rejected[f"sbf/{MEAS_EPOCH} unknown signal"] += unknown
        if count < total:
            ids, sources, channel, flags = ids[:, :count], sources[:, :count].copy(), channel[:count], flags[:count]
            columns = columns[:, :count].copy()
        v = columns
        return Epoch(time, ids[0], ids[1], channel, flags, v[0], v[1], v[2], v[3], v[4], v[5], v[6]), sources

    def _count_jumps(self, jumps: int) -> None:
        """Count clock jumps: the block has their sum in milliseconds, modulo 256."""
        if self._jumps is not None and jumps != self._jumps:
            self.clock_resets += 1
        self._jumps = jumps

    def _meas_extra(self, data: bytes) -> list[Message] | str:
        """Complete the epoch that waits; the first MeasExtra of a stream comes too late, but tells that others follow."""
        time, held = _time_of(data), self._held
        if held is None:
            self._extra_comes = time is not None and self._last is not None and self._last.time == time
            return []
        epoch, sources = held
        if time != epoch.time:
            return self._flush_epoch()
        cn0, code, phase = epoch.cn0_dbhz.copy(), epoch.pseudorange_sigma_m.copy(), epoch.phase_sigma_cyc.copy()
        if len(data) < HEAD or not add_extra(data, len(data), self._antenna, sources, cn0, code, phase):
            self.counters.rejected[f"sbf/{MEAS_EXTRA} length"] += 1
            return self._flush_epoch()
        self._held = None
        return [replace(epoch, cn0_dbhz=cn0, pseudorange_sigma_m=code, phase_sigma_cyc=phase)]


def _one(found: Message | str | None) -> list[Message] | str:
    """Return what a block says as a list, or why it is refused."""
    return found if isinstance(found, str) else [] if found is None else [found]


def _time_of(data: bytes) -> GpsTime | None:
    """Return the time of a block, None where the receiver knows none."""
    if len(data) < _TIME_OFFSET + _TIME.size:
        return None
    tow_ms, week = _TIME.unpack_from(data, _TIME_OFFSET)
    return GpsTime(week, tow_ms / 1e3) if week != _NO_WEEK and week > 0 and tow_ms < _WEEK_MS else None
