"""How a target is held to its word: nothing raised, nothing slow, nothing that grows, every frame accounted for."""

import gc
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from time import thread_time
from typing import Any, Final

from rtkmesh.codecs.messages import DecodingCounters

LIMIT_S: Final = 0.002  # of one frame (reliability.md, fault 19)
GROWTH_BYTES: Final = 8 << 20  # that resident memory may differ by: the allocator's own grain
_REPLAYS: Final = 3  # of a run with slow pieces: the same pieces meet the same state, and the shortest time counts
_YARDSTICK_S: Final = 0.001  # that an ordinary machine takes for the yardstick
_NOTES: Final = (  # of frames that are decoded: refusals of a part of them, or of the epoch that they belong to
    "cell of unknown", "unknown signal", "epoch ", "late or ", "redundant",
)  # fmt: skip


@dataclass(slots=True)
class Reader:
    """What takes the pieces, and how it is asked for its counters at the end (None: it has none)."""

    feed: Callable[[bytes], Any]
    end: Callable[[], DecodingCounters | None] = lambda: None


@dataclass(frozen=True, slots=True)
class Target:
    """One thing that reads what others send.

    ``pieces(seed)`` yields what to feed, for ever and always the same; ``make`` returns a fresh reader; ``share``: of the pieces of
    a run, to this target.
    """

    name: str
    pieces: Callable[[int], Iterator[bytes]]
    make: Callable[[], Reader]
    share: float
    limit_s: float = LIMIT_S


@dataclass(slots=True)
class Outcome:
    """What a run showed. Times are of the processor: others on the machine do not count."""

    name: str
    pieces: int = 0
    bytes: int = 0
    seconds: float = 0.0
    worst_s: float = 0.0
    growth_bytes: int = 0
    slow: dict[int, float] = field(default_factory=dict[int, float])  # by number of the piece
    failures: list[str] = field(default_factory=list[str])

    @property
    def row(self) -> str:
        """One line of the table of figures."""
        rate = self.pieces / self.seconds if self.seconds else 0.0
        took = f"{self.seconds:>7.1f} s {rate:>8.0f}/s {self.worst_s * 1e3:>7.2f} ms"
        return f"{self.name:<14} {self.pieces:>9} {took} {self.growth_bytes >> 10:>7} KiB"


def resident_bytes() -> int:
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def run(target: Target, count: int, seed: int = 1) -> Outcome:
    """Feed so many pieces and return what came of it; an exception ends the run and names the piece."""
    outcome, reader = Outcome(target.name), target.make()
    middle = 0
    gc.collect()
    for number, piece in enumerate(islice(target.pieces(seed), count)):
        if number == count // 2:
            middle = resident_bytes()
        try:
            took = _timed(reader.feed, piece)
        except Exception as error:  # noqa: BLE001  it is what we look for
            outcome.failures.append(f"{type(error).__name__}: {error} for piece {number}: {piece.hex()}")
            return outcome
        _count(outcome, number, len(piece), took, target.limit_s)
    outcome.growth_bytes = resident_bytes() - middle
    counters = reader.end()
    _judge_time(target, outcome, seed)
    if outcome.growth_bytes > GROWTH_BYTES:
        outcome.failures.append(f"memory grew by {outcome.growth_bytes >> 10} KiB in the second half")
    if counters is not None and (counted := accounted(counters)) != outcome.pieces:
        outcome.failures.append(f"{outcome.pieces} frames, but {counted} are decoded, ignored or rejected")
    return outcome


def accounted(counters: DecodingCounters) -> int:
    """Return how many frames are decoded, ignored or rejected as a whole."""
    refused = sum(count for name, count in counters.rejected.items() if not any(note in name for note in _NOTES))
    ignored = sum(count for name, count in counters.ignored.items() if "epoch of" not in name)
    return counters.decoded.total() + ignored + refused


def _timed(feed: Callable[[bytes], Any], piece: bytes) -> float:
    started = thread_time()
    feed(piece)
    return thread_time() - started


def _slowness() -> float:
    """Return how many times as long as on an ordinary machine anything takes now (1 at least): a neighbour may have the caches."""
    words = {}
    started = thread_time()
    for number in range(5000):
        words[str(number)] = [number]
    return max(1.0, (thread_time() - started) / _YARDSTICK_S)


def _count(outcome: Outcome, number: int, size: int, took: float, limit_s: float) -> None:
    outcome.pieces += 1
    outcome.bytes += size
    outcome.seconds += took
    if took > limit_s:
        outcome.slow[number] = took
    elif took > outcome.worst_s:
        outcome.worst_s = took


def _judge_time(target: Target, outcome: Outcome, seed: int) -> None:
    """Play a run with slow pieces again; those that are slow each time, for a machine as it is in that moment, are failures."""
    for _ in range(_REPLAYS):
        if not outcome.slow:
            return
        reader = target.make()
        for number, piece in enumerate(islice(target.pieces(seed), max(outcome.slow) + 1)):
            took = _timed(reader.feed, piece)
            if number in outcome.slow:
                outcome.slow[number] = min(took / _slowness(), outcome.slow[number])
        quick = {number: took for number, took in outcome.slow.items() if took <= target.limit_s}
        outcome.slow = {number: took for number, took in outcome.slow.items() if number not in quick}
        outcome.worst_s = max(outcome.worst_s, *quick.values(), 0.0)
    outcome.worst_s = max(outcome.worst_s, *outcome.slow.values(), 0.0)
    outcome.failures += [f"piece {number} takes {took * 1e3:.2f} ms every time" for number, took in outcome.slow.items()]
