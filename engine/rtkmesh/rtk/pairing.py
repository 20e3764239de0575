"""Which base epoch belongs to which rover epoch, and when to stop waiting for it.

Epochs are paired by their time tags. A rover epoch waits for the base epoch that is expected for it, until a deadline:

* Live, the deadline is a clock that the caller passes in. The base's cadence is learned, so that a 10 Hz rover does not wait for
  epochs that a 1 Hz base never sends; whether the base's stream reorders is learned too.
* In replay the clock is the base log's own: a rover epoch is given up at the first base epoch that, in a log that has kept its order
  and by its cadence so far, leaves nothing to wait for, at the latest when the base has passed it by ``maximum_wait_s``. The result
  then depends on the two streams alone, never on how they were interleaved.

A base epoch of the future is used in replay alone, and only where none of the past will do: at the start of a base's log, and after its
long gaps; and, where it is asked for, beside the past one: the base is then interpolated (``resampling``). An epoch that comes twice counts
once, and rover epochs leave in rising time order.
"""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from dataclasses import dataclass, field
from itertools import islice, pairwise, takewhile
from math import floor, inf
from typing import Final

from rtkmesh.errors import OptionError
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime

_KEPT_BASES: Final = 512
_CADENCE_GAPS: Final = 20  # base gaps that the cadence is learned from
_FIRST_WAITS: Final = 3.0  # a base that never sent is waited for during so many maximum waits
_ORDERLY_EPOCHS: Final = 50  # base epochs in order before the stream is trusted not to reorder
_FIRST_REORDER_WAIT_S: Final = 0.45
_ORDERLY_REORDER_WAIT_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class PairingOptions:
    """How rover and base epochs are paired.

    ``tolerance_s``: largest difference of tags of one epoch (receiver clock steering); ``maximum_wait_s``: how long a rover
    epoch waits; ``matched_only``: never use another base epoch than the matching one; ``silent_s``: a base that sent nothing for so
    long is not waited for, and an epoch so old is of no use; ``has_base``: False in mode single; ``replay``: the deadline clock is the
    base log's; ``capacity``: rover epochs that may wait (live: the oldest is dropped and counted beyond that); ``interpolate`` (replay
    alone): a rover epoch without a matching base epoch gets those on both sides of it, if they are not more than ``silent_s`` apart.
    """

    tolerance_s: float = 0.025
    maximum_wait_s: float = 1.0
    matched_only: bool = False
    silent_s: float = 30.0
    has_base: bool = True
    replay: bool = False
    capacity: int = 256
    interpolate: bool = False

    def __post_init__(self) -> None:
        if self.interpolate and not self.replay:
            raise OptionError("base epochs can be interpolated in recordings alone: live the next one is not known yet")

    @property
    def reach_s(self) -> float:
        """How much later than a rover epoch the base epochs are that it waits for (s)."""
        return max(self.maximum_wait_s, self.silent_s) if self.interpolate else self.maximum_wait_s


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A rover epoch on its way to the engine, with its base epoch or None; ``order`` is its place in the rover's stream.

    ``later`` is the base epoch after it where the base may be interpolated. ``age_s``: how much older than the rover epoch the nearest
    base epoch is of which the base's was made; None: what the tags say.
    """

    rover: Epoch
    base: Epoch | None
    order: int
    waited_s: float
    later: Epoch | None = None
    age_s: float | None = None


@dataclass(slots=True)
class PairingCounters:
    """What happened to epochs."""

    paired: int = 0
    unmatched: int = 0
    rover_duplicates: int = 0
    rover_late: int = 0
    rover_dropped: int = 0
    base_duplicates: int = 0
    base_reordered: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting:
    epoch: Epoch
    order: int
    arrived_s: float


@dataclass(slots=True, eq=False)
class _Base:
    epoch: Epoch
    order: int
    arrived_s: float
    interval_s: float = -inf  # the log's cadence when this epoch came; -inf while the log was not known to keep its order

    def __lt__(self, other: "_Base") -> bool:
        return self.epoch.time < other.epoch.time


def _time_of(base: _Base) -> GpsTime:
    return base.epoch.time


@dataclass(slots=True)
class Pairing:
    """The matching buffer of one solver. Mutable; holds epochs only."""

    options: PairingOptions
    counters: PairingCounters = field(default_factory=PairingCounters)
    _rovers: deque[_Waiting] = field(default_factory=deque[_Waiting])
    _bases: list[_Base] = field(default_factory=list[_Base])
    _rover_order: int = 0
    _base_order: int = 0
    _base_ended: bool = False
    _last_solved: GpsTime | None = None
    _base_arrived_s: float = -inf
    _first_rover_s: float = inf
    _reorder_wait_s: float = _FIRST_REORDER_WAIT_S
    _orderly: int = 0  # base epochs in order since one came late, anew or again: one that comes again may be forgotten
    _gaps_s: deque[float] = field(default_factory=lambda: deque[float](maxlen=_CADENCE_GAPS))  # the newest gaps between base epochs
    _longest_s: float = -inf  # the slowest cadence that a base epoch came with

    def __len__(self) -> int:
        return len(self._rovers)

    @property
    def rover_order(self) -> int:
        """Number of rover epochs seen so far."""
        return self._rover_order

    def add_rover(self, epoch: Epoch, now_s: float) -> None:
        """Take a rover epoch that arrived at ``now_s`` (s, the caller's monotonic clock; unused in replay)."""
        self._rover_order += 1
        self._first_rover_s = min(self._first_rover_s, now_s)
        if self._last_solved is not None and epoch.time - self._last_solved <= 0.0:
            if epoch.time == self._last_solved:
                self.counters.rover_duplicates += 1
            else:
                self.counters.rover_late += 1
            return
        if any(waiting.epoch.time == epoch.time for waiting in self._rovers):
            self.counters.rover_duplicates += 1
            return
        self._rovers.append(_Waiting(epoch, self._rover_order, now_s))
        if len(self._rovers) > 1 and self._rovers[-2].epoch.time > epoch.time:
            self._rovers = deque(sorted(self._rovers, key=lambda waiting: waiting.epoch.time))
        if len(self._rovers) > self.options.capacity and not self.options.replay:
            self._rovers.popleft()
            self.counters.rover_dropped += 1

    def add_base(self, epoch: Epoch, now_s: float) -> None:
        """Take a base epoch that arrived at ``now_s``."""
        self._base_order += 1
        self._base_arrived_s = now_s
        known = self._match(epoch.time, inf)
        if known is not None:
            self.counters.base_duplicates += 1
            self._orderly = self._orderly if known is self._bases[-1].epoch else 0
            return
        base = _Base(epoch, self._base_order, now_s)
        if self._bases and epoch.time < self._bases[-1].epoch.time:
            self._learn_reordering(base)
            insort(self._bases, base)
            self._count_gaps()
        else:
            self._follow_on(base)
        if self._orderly >= _ORDERLY_EPOCHS:
            base.interval_s = self._interval_s()
            self._longest_s = max(self._longest_s, base.interval_s)
        if len(self._bases) > _KEPT_BASES and not self.options.replay:
            del self._bases[0]

    def _follow_on(self, base: _Base) -> None:
        """Take a base epoch that came in order."""
        if self._bases:
            self._gaps_s.append(base.epoch.time - self._bases[-1].epoch.time)
        self._bases.append(base)
        self._orderly += 1
        if self._orderly >= _ORDERLY_EPOCHS:
            self._reorder_wait_s = _ORDERLY_REORDER_WAIT_S

    def _count_gaps(self) -> None:
        """Count the newest gaps anew."""
        self._gaps_s.clear()
        self._gaps_s.extend(b.epoch.time - a.epoch.time for a, b in pairwise(self._bases[-_CADENCE_GAPS - 1 :]))

    @property
    def base_arrived_s(self) -> float:
        """When the newest base epoch arrived (the caller's clock); -inf: none has."""
        return self._base_arrived_s

    def change_base(self) -> list[Epoch]:
        """Let another base follow: return the epochs of the old one, oldest first, and forget what was learned of its stream.

        Rover epochs that wait are paired with the new one.
        """
        epochs = [base.epoch for base in self._bases]
        self._bases.clear()
        self._gaps_s.clear()
        self._base_order, self._base_ended, self._orderly = 0, False, 0
        self._base_arrived_s, self._reorder_wait_s = -inf, _FIRST_REORDER_WAIT_S
        self._first_rover_s = -inf  # where no base follows nothing is waited for
        return epochs

    def end_base(self) -> None:
        """No further base epoch will come."""
        self._base_ended = True

    def next_pair(self, now_s: float) -> Pair | None:
        """Return the oldest rover epoch if its waiting is over, with its base epoch; None while it waits."""
        if not self._rovers:
            return None
        waiting = self._rovers[0]
        cut = self._cut(waiting.epoch.time) if self.options.replay else inf
        found, base, later = self._decide(waiting, cut, now_s)
        if not found:
            return None
        self._rovers.popleft()
        self._last_solved = waiting.epoch.time
        self._count(waiting, base)
        self._forget(waiting.epoch.time, cut)
        waited_s = 0.0 if self.options.replay else max(0.0, now_s - waiting.arrived_s)
        return Pair(waiting.epoch, base, waiting.order, waited_s, later)

    def deadline_s(self) -> float:
        """Return the instant (caller's clock) at which ``next_pair`` must be asked again without new input; inf if none."""
        if not self._rovers or self.options.replay or not self.options.has_base:
            return inf
        waiting = self._rovers[0]
        due = min(waiting.arrived_s + self.options.maximum_wait_s, self._silent_from_s())
        newer = self._first_newer(waiting.epoch.time)
        return due if newer is None else min(due, max(newer.arrived_s, waiting.arrived_s) + self._reorder_wait_s)

    def waiting_for(self) -> GpsTime | None:
        """Return the time of the oldest rover epoch that waits, or None."""
        return self._rovers[0].epoch.time if self._rovers else None

    def clear(self) -> None:
        """Forget all epochs (not what was learned of the streams)."""
        self._rovers.clear()
        self._bases.clear()
        self._gaps_s.clear()

    def _decide(self, waiting: _Waiting, cut: float, now_s: float) -> tuple[bool, Epoch | None, Epoch | None]:
        """Return (whether waiting is over, base epoch, the one after the rover's where both may be interpolated).

        Base epochs beyond ``cut`` in the stream came too late.
        """
        options, time = self.options, waiting.epoch.time
        if not options.has_base:
            return True, None, None
        match = self._match(time, cut)
        if match is not None:
            return True, match, None
        over = (self._base_ended or cut < inf) if options.replay else self._given_up(waiting, now_s)
        if not over:
            return False, None, None
        if options.matched_only:
            return True, None, None
        other = self._other(time, cut)
        return True, other, self._beyond(other, time, cut)

    def _other(self, time: GpsTime, cut: float) -> Epoch | None:
        """Return the base epoch that serves where none matches."""
        before = self._newest_before(time, cut)
        if not self.options.replay or (before is not None and time - before.time <= self.options.silent_s):
            return before
        return self._oldest_after(time, cut) or before

    def _beyond(self, base: Epoch | None, time: GpsTime, cut: float) -> Epoch | None:
        """Return the base epoch on the other side of a rover epoch; None where the base is not interpolated."""
        if not self.options.interpolate or base is None or base.time > time:
            return None
        later = self._oldest_after(time, cut)
        return later if later is not None and later.time - base.time <= self.options.silent_s + self.options.tolerance_s else None

    def _given_up(self, waiting: _Waiting, now_s: float) -> bool:
        """Live: is there nothing more to wait for? Ends of streams, deadline, cadence and silence of the base decide."""
        time = waiting.epoch.time
        if self._base_ended or now_s >= self.deadline_s():
            return True
        if self.options.matched_only:
            return False
        expected = self._expected(time)
        newest = self._newest_before(time, inf)
        return expected is not None and newest is not None and newest.time - expected >= -self.options.tolerance_s

    def _silent_from_s(self) -> float:
        """Return the instant from which the base counts as silent; one that never spoke gets a few waits from the start."""
        if self._base_arrived_s == -inf:
            return self._first_rover_s + _FIRST_WAITS * self.options.maximum_wait_s
        return self._base_arrived_s + self.options.silent_s

    def _expected(self, time: GpsTime) -> GpsTime | None:
        """Return the newest epoch that the base's cadence promises up to ``time``; None while the cadence is not known."""
        interval = self._interval_s()
        if interval == -inf:
            return None
        newest = self._bases[-1].epoch.time
        return newest + floor((time - newest + self.options.tolerance_s) / interval) * interval

    def _interval_s(self) -> float:
        """Return the base's cadence: the smallest of its newest gaps; -inf while it is not known."""
        return min(self._gaps_s) if len(self._gaps_s) > 1 else -inf

    def _cut(self, time: GpsTime) -> float:
        """Return the stream order of the first base epoch that ends the wait for ``time`` on the log's clock; inf if none yet."""
        cut, from_s = inf, min(0.0, self.options.tolerance_s - self._longest_s)
        for base in reversed(self._bases):
            passed_s = base.epoch.time - time
            if passed_s < from_s:
                break
            if self._ends_wait(base, passed_s):
                cut = min(cut, base.order)
        return max(cut, self._passed(time)) if self.options.interpolate else cut

    def _passed(self, time: GpsTime) -> float:
        """Return the stream order of the first base epoch beyond ``time``; inf if none has come."""
        limit = time + self.options.tolerance_s
        newer = takewhile(lambda base: base.epoch.time > limit, reversed(self._bases))
        return min((base.order for base in newer), default=inf)

    def _ends_wait(self, base: _Base, passed_s: float) -> bool:
        """Replay: whether at this base epoch, ``passed_s`` later, nothing was left to wait for: a function of the base's log up to it."""
        return passed_s >= self.options.maximum_wait_s or passed_s > self.options.tolerance_s - base.interval_s

    def _match(self, time: GpsTime, cut: float) -> Epoch | None:
        """Return the base epoch whose tag is nearest to ``time`` within the tolerance, among those up to ``cut`` in the stream."""
        best, best_gap = None, self.options.tolerance_s
        for base in reversed(self._bases):
            gap = base.epoch.time - time
            if gap < -self.options.tolerance_s:
                break
            if abs(gap) <= best_gap and base.order <= cut:
                best, best_gap = base.epoch, abs(gap)
        return best

    def _newest_before(self, time: GpsTime, cut: float) -> Epoch | None:
        limit = time + self.options.tolerance_s
        return next((base.epoch for base in reversed(self._bases) if base.epoch.time <= limit and base.order <= cut), None)

    def _oldest_after(self, time: GpsTime, cut: float) -> Epoch | None:
        after = bisect_right(self._bases, time, key=_time_of)
        return next((base.epoch for base in islice(self._bases, after, None) if base.order <= cut), None)

    def _first_newer(self, time: GpsTime) -> _Base | None:
        """Return the base epoch beyond ``time`` that arrived first."""
        limit = time + self.options.tolerance_s
        newer = [base for base in self._bases if base.epoch.time > limit]
        return min(newer, key=lambda base: base.arrived_s, default=None)

    def _learn_reordering(self, base: _Base) -> None:
        """A base epoch was overtaken: wait for such from now on, half as long again as this one was late."""
        overtaker = self._bases[bisect_left(self._bases, base)]
        late_s = base.arrived_s - overtaker.arrived_s
        self.counters.base_reordered += 1
        self._orderly = 0
        self._reorder_wait_s = min(self.options.maximum_wait_s, max(self._reorder_wait_s, _FIRST_REORDER_WAIT_S, 1.5 * late_s))

    def _count(self, waiting: _Waiting, base: Epoch | None) -> None:
        if base is not None and abs(base.time - waiting.epoch.time) <= self.options.tolerance_s:
            self.counters.paired += 1
        else:
            self.counters.unmatched += 1

    def _forget(self, time: GpsTime, cut: float) -> None:
        """Drop base epochs that no later rover epoch can use, but keep what the cadence needs.

        They are those before the newest one that came in time for this rover epoch, for it came in time for later ones too. One that came
        too late for this one may be too late for the next as well.
        """
        newest = bisect_right(self._bases, time, key=_time_of) - 1
        while newest >= 0 and self._bases[newest].order > cut:
            newest -= 1
        surplus = min(newest, len(self._bases) - _CADENCE_GAPS - 1)
        if surplus > 0:
            del self._bases[:surplus]
