"""One ingest's numbered messages, back in stream order.

Zenoh keeps the order of one session's messages of one priority, but cached ones may come late. A message is held while an earlier
one is missing, at most for ``hold_s``; then the missing ones are counted as lost and the stream goes on.
"""

from dataclasses import dataclass, field
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
    _held: dict[int, tuple[float, T]] = field(default_factory=dict[int, tuple[float, T]])

    def take(self, item: T, start_id: str, sequence: int, now_s: float, *, anchors: bool = True, joins: bool = False) -> list[T]:
        """Take a message and return all that are now in order.

        ``anchors``: an unnumbered beginning starts with this one; ``joins``: the stream is known to have begun without us, so
        nothing before this one is missing.
        """
        if start_id != self.start_id:
            self._begin(start_id)
        before = self._before(sequence) if joins else []
        return before + self._sequenced(item, sequence, now_s, anchors=anchors)

    def overdue(self, now_s: float) -> list[T]:
        """Return messages whose missing predecessors have been waited for long enough; those count as lost."""
        ready: list[T] = []
        while self._held and self._next is not None and now_s - self._held[first := min(self._held)][0] >= self.hold_s:
            self.lost += first - self._next
            self._next = first
            ready += self._in_order()
        return ready

    def _sequenced(self, item: T, sequence: int, now_s: float, *, anchors: bool) -> list[T]:
        if self._next is None:
            if not anchors:
                return [item]
            self._next = sequence
        if sequence < self._next:
            return [] if anchors else [item]  # a repeated epoch, or cached navigation data from before
        self._held[sequence] = now_s, item
        return self._in_order()

    def _before(self, sequence: int) -> list[T]:
        """Let the stream go on at ``sequence``; return what was held before it."""
        self._next = max(self._next or 0, sequence)
        return [self._held.pop(number)[1] for number in sorted(self._held) if number < sequence]

    def _begin(self, start_id: str) -> None:
        self.restarts += bool(self.start_id)
        self.start_id = start_id
        self._next = 0 if self.complete else None
        self._held.clear()

    def _in_order(self) -> list[T]:
        assert self._next is not None, "the stream has begun"
        ready: list[T] = []
        while self._next in self._held:
            ready.append(self._held.pop(self._next)[1])
            self._next += 1
        return ready
