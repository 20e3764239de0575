"""One ingest's numbered messages, back in stream order.

Zenoh keeps the order of one session's messages of one priority, but cached ones may come late. A message is held while an earlier
one is missing, at most for ``hold_s``; then the missing ones are counted as lost and the stream goes on.
"""

from dataclasses import dataclass, field
from math import inf
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(slots=True)
class Sequencer(Generic[T]):
    """The order of one ingest. ``complete``: its stream is known to begin at 0 (replays); else it begins with what comes first."""

    hold_s: float = 0.1
    complete: bool = False
    lost: int = 0
    restarts: int = 0
    start_id: str = ""
    _next: int | None = None
    _held: dict[int, T] = field(default_factory=dict[int, T])
    _held_since_s: float = inf

    def take(self, item: T, start_id: str, sequence: int, now_s: float, *, anchors: bool = True) -> list[T]:
        """Take a message and return all that are now in order. ``anchors``: an unnumbered beginning starts with this one."""
        if start_id != self.start_id:
            self._begin(start_id)
        if self._next is None:
            if not anchors:
                return [item]
            self._next = sequence
        if sequence < self._next:
            return [] if anchors else [item]  # a repeated epoch, or cached navigation data from before
        self._held[sequence] = item
        return self._in_order(now_s)

    def overdue(self, now_s: float) -> list[T]:
        """Return messages whose missing predecessors have been waited for long enough; those count as lost."""
        if not self._held or now_s - self._held_since_s < self.hold_s or self._next is None:
            return []
        first = min(self._held)
        self.lost += first - self._next
        self._next = first
        return self._in_order(now_s)

    def _begin(self, start_id: str) -> None:
        self.restarts += bool(self.start_id)
        self.start_id = start_id
        self._next = 0 if self.complete else None
        self._held.clear()
        self._held_since_s = inf

    def _in_order(self, now_s: float) -> list[T]:
        assert self._next is not None, "the stream has begun"
        ready: list[T] = []
        while self._next in self._held:
            ready.append(self._held.pop(self._next))
            self._next += 1
        if ready or self._held_since_s == inf:
            self._held_since_s = now_s if self._held else inf
        return ready
