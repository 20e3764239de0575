"""From RTCM 3 observation messages to epochs: whose week is it, which messages belong together, when is the epoch whole.

The clock of a stream is the time of its newest epoch. Every epoch time tag of every system is first brought to milliseconds
of the GPS week and only then to a full time near that clock, once per message, so that the tags of one epoch (GPS, BDT 14 s
behind, GLONASS day time) can never fall into different weeks.
"""

from collections import Counter, deque
from math import floor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.observation_rows import (
    PRIORITY_SHIFT,
    ROW_MASK,
    SATELLITE_SHIFT,
    SIGNAL_MASK,
    SIGNAL_SHIFT,
    CellRows,
    Rows,
    ValueRows,
    sort_keys,
)
from rtkmesh.codecs.rtcm3_msm import MSM_PRIORITY, NO_DAY, Part
from rtkmesh.codecs.utc import leap_seconds_of
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.signals import BEIDOU, GLONASS, MAX_SATELLITE, MAX_SIGNAL, SBAS
from rtkmesh.gnss.time import GpsTime

DAY_MS: Final = 86_400_000
WEEK_MS: Final = 7 * DAY_MS
MOSCOW_MS: Final = 10_800_000  # GLONASS time is UTC + 3 h
TAG_SPAN: Final = 1 << 30  # epoch time fields have 30 bits
DAYTIME_MASK: Final = (1 << 27) - 1

_BDT_MINUS_GPST_MS: Final = round(BDT_MINUS_GPST_S * 1e3)
_SURE_MS: Final = 60_000
_DAYLESS: Final = 5  # GLONASS messages without a day that wait for a better time

_SAME_EPOCH_S: Final = 0.0015  # time tags are whole milliseconds, rounded by the sender
_REPLAY_S: Final = 60.0  # what is this much older than the newest epoch came late or is repeated
_OVERTAKEN_S: Final = 5.0  # but a whole epoch that newer ones overtook on their way is taken up to this late, once
_RECENT: Final = 64  # epochs that are remembered to tell an overtaken one from a repeated one
_JUMP_S: Final = 86_400.0  # a step forward of more than this must be confirmed
_CONFIRMATIONS: Final = 5  # messages that must agree before a step back or a jump is believed
_ZERO_LOCK: Final = -1.0
_TRUST_AFTER: Final = 10  # epochs with a right end mark before a stream that had a wrong one is believed again


def week_ms(system: int, tag: int, clock: GpsTime) -> int | None:
    """Return the GPST time of week (ms) of a raw epoch time field, None if it is out of its range.

    GLONASS: day of week (7 is unknown) and time of day in UTC + 3 h (DF416, DF034). BeiDou: BDT (DF427), which some receivers
    send negative in the first 14 s of the GPS week. All others: GPST (DF004, DF248, DF428, DF546); SBAS tags with the time
    of day exist as well. A day is not believed against a clock that agrees with the time of day within a minute.
    """
    if system == GLONASS:
        time_ms, clock_ms = tag & DAYTIME_MASK, round(clock.tow_s * 1e3)
        if time_ms >= DAY_MS + 1000:  # a leap second is the 86401st
            return None
        gpst_ms = time_ms - MOSCOW_MS + leap_seconds_of(clock) * 1000
        near_ms, day = _on_day_of(clock_ms, gpst_ms), tag >> 27
        return (near_ms if day == NO_DAY or abs(near_ms - clock_ms) < _SURE_MS else day * DAY_MS + gpst_ms) % WEEK_MS
    if system == BEIDOU:
        tag -= _BDT_MINUS_GPST_MS
        return tag % WEEK_MS if tag < WEEK_MS + 14_000 else tag - TAG_SPAN if tag >= TAG_SPAN else None
    if system == SBAS:
        near_ms = _on_day_of(round(clock.tow_s * 1e3), tag)
        if abs(near_ms - round(clock.tow_s * 1e3)) < _SURE_MS:
            return near_ms % WEEK_MS
    return tag if tag < WEEK_MS else None


def _on_day_of(clock_ms: int, time_ms: int) -> int:
    """Return ``time_ms`` moved by whole days to be nearest to ``clock_ms``."""
    return time_ms + round((clock_ms - time_ms) / DAY_MS) * DAY_MS


def _near(tag_ms: int, clock: GpsTime) -> GpsTime:
    """Return the instant with this time of week that is nearest to the clock, exact to the last bit of its milliseconds."""
    return GpsTime(clock.week + floor((clock.tow_s * 1e3 - tag_ms) / WEEK_MS + 0.5), tag_ms / 1e3)


class LockMemory:
    """The last lock time of each (satellite, signal) of a stream, from which slips are found."""

    def __init__(self) -> None:
        self.lock_s = np.zeros((MAX_SATELLITE, MAX_SIGNAL), np.float32)  # 0: none came yet, _ZERO_LOCK: zero
        self.used = False  # whether any lock time but zero came


@kernel
def merge_rows(
    cells: CellRows, values: ValueRows, begin: int, end: int, memory_s: NDArray[np.float32], used: bool,
    ids: NDArray[np.int16], channel: NDArray[np.int8], flags: NDArray[np.uint8], columns: NDArray[np.float64],
) -> tuple[int, bool]:  # fmt: skip
    """Sort the rows ``begin`` to ``end`` of one epoch by (satellite, signal), keep each once, and mark slips.

    A slip is a lock time below the one before it, or zero twice in a stream that is known to send lock times (NaN: not known).
    ``memory_s`` and ``used`` are those of LockMemory. Out: ``ids`` (2, n), ``channel``, ``flags``, and ``columns`` (7, n), of which the
    last two are what the messages do not say. Returns the number of rows and the new ``used``.
    """
    keys = np.empty(end - begin, np.int64)
    for i in range(end - begin):
        cell = cells[begin + i]
        keys[i] = np.int64(cell[0]) << SATELLITE_SHIFT | np.int64(cell[1]) << SIGNAL_SHIFT | np.int64(cell[4]) << PRIORITY_SHIFT | i
    rows = sort_keys(keys)
    for k in range(rows):
        satellite, signal, row = keys[k] >> SATELLITE_SHIFT, keys[k] >> SIGNAL_SHIFT & SIGNAL_MASK, begin + (keys[k] & ROW_MASK)
        lock_s, before_s = float(np.float32(values[row, 4])), memory_s[satellite, signal]
        used = used or lock_s > 0.0
        slipped = lock_s < before_s or (lock_s == 0.0 and before_s == _ZERO_LOCK and used)
        if not np.isnan(lock_s):
            memory_s[satellite, signal] = lock_s if lock_s > 0.0 else _ZERO_LOCK
        ids[0, k], ids[1, k], channel[k] = satellite, signal, cells[row, 2]
        flags[k] = cells[row, 3] | (SLIP if slipped else 0)
        for j in range(5):
            columns[j, k] = values[row, j]
        columns[5, k] = columns[6, k] = np.nan
    return rows, used


def merge_epoch(time: GpsTime, rows: Rows, memory: LockMemory) -> Epoch | None:
    """Return the epoch of the rows in use, which are then no longer, None if there are none; of a signal that comes twice one is kept."""
    count, begin, rows.begin = rows.end - rows.begin, rows.begin, rows.end
    if not count:
        return None
    ids, channel, flags = np.empty((2, count), np.int16), np.empty(count, np.int8), np.empty(count, np.uint8)
    v = np.empty((7, count))
    kept, memory.used = merge_rows(
        rows.cells, rows.values, begin, begin + count, memory.lock_s, memory.used, ids, channel, flags, v
    )  # fmt: skip
    if kept < count:
        ids, channel, flags, v = ids[:, :kept], channel[:kept], flags[:kept], v[:, :kept].copy()
    return Epoch(time, ids[0], ids[1], channel, flags, v[0], v[1], v[2], v[3], v[4], v[5], v[6])


class Redundancy:
    """Leaves out legacy messages of a system whose MSM come in the same stream: they end an epoch too early and say less."""

    def __init__(self) -> None:
        self._time: GpsTime | None = None
        self._now: set[tuple[int, int]] = set()  # (station, system) of MSM at that time
        self._before: set[tuple[int, int]] = set()  # and at the time before
        self._skipped: GpsTime | None = None  # newest time whose legacy messages were left out

    def skips(self, part: Part, time: GpsTime) -> bool:
        """Return whether to leave out a message. One epoch is lost when a stream changes from MSM to legacy messages."""
        key, is_new = (part.station_id, part.system), time is not self._time and time != self._time
        if part.priority == MSM_PRIORITY:
            if is_new:
                self._time, self._before, self._now = time, self._now, set()
            self._now.add(key)
            return False
        if key not in self._now and (is_new or key not in self._before):
            return False
        if is_new and self._skipped not in (None, self._time, time):
            self._now.clear()
            self._before.clear()
            return False
        self._skipped = time
        return True


class EpochGatherer:
    """Gathers observation messages into epochs; ``rejected`` counts what came late, twice or out of range.

    An epoch is whole when a message says that no more follow, when the epoch time changes, or at ``flush``. A stream whose end
    marks prove wrong (messages of further systems follow) is gathered by the change of time until they are right again.
    """

    def __init__(self, clock: GpsTime | None, rejected: Counter[str]) -> None:
        self.clock = clock
        self.observed = False  # the clock is the time of an epoch of this stream
        self._rejected = rejected
        self._parts: list[Part] = []
        self._time: GpsTime | None = None  # of the parts, or of the epoch that was just finished
        self._tag_ms = -1  # its time of week
        self._finished: list[Part] = []  # of the epoch just finished
        self._distrust = 0  # epochs that must still end rightly
        self._doubtful: list[GpsTime] = []
        self._dayless = 0
        self._recent: deque[GpsTime] = deque(maxlen=_RECENT)
        self.rows = Rows()  # of the parts, and behind them of the message that is added next
        self._locks = LockMemory()
        self._redundancy = Redundancy()

    def set_clock(self, time: GpsTime) -> None:
        """Take a time from elsewhere: it decides the week until the stream has epochs, and again if they prove days apart."""
        if self.clock is None or not self.observed or abs(time - self.clock) > 3.0 * DAY_MS * 1e-3:
            self.clock, self.observed = time, False

    def add(self, kind: str, part: Part) -> list[Epoch]:
        """Take one message and return the epochs that it completes (none, one, or a forgotten one and its own)."""
        assert self.clock is not None, "the owner holds messages until a time is known"
        tag_ms = week_ms(part.system, int(part.tag), self.clock)
        if tag_ms is None or self._lacks_day(part):
            self._rejected[f"{kind} epoch time"] += 1
            return []
        time = self._time if tag_ms == self._tag_ms and self._time is not None else _near(tag_ms, self.clock)
        if self._redundancy.skips(part, time):
            self._rejected[f"{kind} redundant beside MSM"] += 1
            return []
        if time is self._time:
            return self._same_epoch(kind, part)
        step_s = time - self.clock
        if self._is_same_epoch(time, step_s):
            return self._same_epoch(kind, part)
        overtaken = self._was_overtaken(time, step_s)
        if not overtaken and not self._believable(time, step_s):
            self._rejected[f"{kind} late or jumping"] += 1
            return []
        done = self.flush()
        self._doubtful.clear()
        self._time, self._tag_ms, self._parts = time, tag_ms, [part]
        self.rows.end += part.rows
        if not overtaken:
            self.clock, self.observed = time, True
        return done + self._end_if(part) if done else self._end_if(part)

    def flush(self) -> list[Epoch]:
        """Return the unfinished epoch, if there is one."""
        if not self._parts or self._time is None:
            return []
        if self._distrust:
            rightly = [part.more for part in self._parts] == [True] * (len(self._parts) - 1) + [False]
            self._distrust = self._distrust - 1 if rightly else _TRUST_AFTER
        self._finished, self._parts = self._parts, []
        self._recent.append(self._time)
        in_order = self.clock is None or self._time is self.clock or self._time >= self.clock
        epoch = merge_epoch(self._time, self.rows, self._locks if in_order else LockMemory())
        return [] if epoch is None else [epoch]

    def _same_epoch(self, kind: str, part: Part) -> list[Epoch]:
        if self._parts and part.station_id == self._parts[0].station_id:
            self._parts.append(part)
            self.rows.end += part.rows
            return self._end_if(part)
        self._rejected[f"{kind} late or repeated"] += 1
        systems = [other.system for other in self._finished if other.station_id == part.station_id]
        if not self._parts and systems and part.system not in systems:
            self._distrust = _TRUST_AFTER
        return []

    def _lacks_day(self, part: Part) -> bool:
        """Return whether to leave out a GLONASS message without day: a clock from elsewhere may be half a day off."""
        if self.observed or part.system != GLONASS or part.tag >> 27 != NO_DAY or self._dayless == _DAYLESS:
            return False
        self._dayless += 1
        return True

    def _end_if(self, part: Part) -> list[Epoch]:
        return self.flush() if not part.more and not self._distrust else []

    def _is_same_epoch(self, time: GpsTime, step_s: float) -> bool:
        """Return whether a time, ``step_s`` after the clock, is that of the parts."""
        if self._time is self.clock:
            return abs(step_s) < _SAME_EPOCH_S
        return self._time is not None and abs(time - self._time) < _SAME_EPOCH_S

    def _was_overtaken(self, time: GpsTime, step_s: float) -> bool:
        """Return whether newer epochs came just before this one, which was not there yet."""
        if not self.observed or not 0.0 < -step_s <= _OVERTAKEN_S:
            return False
        return all(abs(time - recent) >= _SAME_EPOCH_S for recent in self._recent)

    def _believable(self, time: GpsTime, step_s: float) -> bool:
        """Return whether an epoch may have this time after the newest one; a jump is believed once messages confirm it."""
        if not self.observed or 0.0 < step_s <= _JUMP_S:
            return True
        if -_REPLAY_S <= step_s <= 0.0:
            return False
        if self._doubtful and not 0.0 <= time - self._doubtful[-1] <= _JUMP_S:
            self._doubtful.clear()
        self._doubtful.append(time)
        return len(self._doubtful) >= _CONFIRMATIONS
