"""The one door into a work loop: bounded, thread-safe, never blocking for those who hand over.

Items leave in the order of arrival over all lanes, urgent lanes first. A full stream lane drops its oldest item and counts
it; a latest-wins lane keeps one item per key, the newest, at the place of the first.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass(slots=True)
class _Lane:
    capacity: int
    urgent: bool = False
    on_drop: Callable[[Any], None] | None = None
    dropped: int = 0
    stream: deque[tuple[int, Any]] = field(default_factory=deque[tuple[int, Any]])
    latest: dict[object, tuple[int, Any]] = field(default_factory=dict[object, tuple[int, Any]])

    def depth(self) -> int:
        return len(self.stream) + len(self.latest)

    def oldest(self) -> int | None:
        heads: list[int] = []
        if self.stream:
            heads.append(self.stream[0][0])
        if self.latest:
            heads.append(next(iter(self.latest.values()))[0])
        return min(heads) if heads else None

    def pop(self) -> Any:
        if self.stream and (not self.latest or self.stream[0][0] < next(iter(self.latest.values()))[0]):
            return self.stream.popleft()[1]
        return self.latest.pop(next(iter(self.latest)))[1]


class Inbox:
    """Bounded queue of lanes between many producers and one work loop."""

    def __init__(self, capacity: int = 1024) -> None:
        self._capacity = capacity
        self._lanes: dict[str, _Lane] = {}
        self._serial = 0
        self._size = 0
        self._closed = False
        self._lock = threading.Lock()
        self._filled = threading.Condition(self._lock)
        self._emptied = threading.Condition(self._lock)
        self._waiting = 0
        self._woken = False

    def lane(self, name: str, *, capacity: int | None = None, urgent: bool = False, on_drop: Callable[[Any], None] | None = None) -> None:
        """Declare a lane (undeclared ones have the inbox's capacity). ``on_drop`` is told each item that had to go."""
        with self._lock:
            if name in self._lanes:
                raise ValueError(f"lane {name!r} is declared twice")
            self._lanes[name] = _Lane(capacity or self._capacity, urgent, on_drop)

    def put(self, item: Any, *, lane: str = "stream", key: object = None) -> None:
        """Hand over an item; with ``key`` only the newest of that key is kept. Never blocks; ignored after ``close``."""
        with self._lock:
            if self._closed:
                return
            row = self._row(lane)
            evicted = self._store(row, item, key)
            if self._waiting:
                self._filled.notify()
        if evicted is not None and row.on_drop is not None:
            row.on_drop(evicted[0])

    def put_wait(self, item: Any, *, lane: str = "stream", timeout_s: float) -> bool:
        """Hand over an item when the lane has room: for our own reading threads, never for Zenoh's. False: timed out or closed."""
        with self._lock:
            row = self._row(lane)
            if not self._emptied.wait_for(lambda: self._closed or row.depth() < row.capacity, timeout_s) or self._closed:
                return False
            self._store(row, item, None)
            if self._waiting:
                self._filled.notify()
            return True

    def get(self, timeout_s: float) -> Any | None:
        """Return the next item; None when ``timeout_s`` passed without one, when woken, or when closed."""
        with self._lock:
            if not self._size and timeout_s > 0.0 and not self._closed and not self._woken:
                self._waiting += 1
                self._filled.wait(timeout_s)
                self._waiting -= 1
            self._woken = False
            if not self._size:
                return None
            self._size -= 1
            item = self._next().pop()
            self._emptied.notify_all()
            return item

    def wake(self) -> None:
        """Let a waiting ``get`` return at once, or the next one: a loop may stand still between its last look and its wait."""
        with self._lock:
            self._woken = True
            self._filled.notify_all()

    def close(self) -> list[Any]:
        """Refuse all further items, wake everybody and return what was left."""
        with self._lock:
            self._closed = True
            left: list[Any] = []
            while self._size:
                self._size -= 1
                left.append(self._next().pop())
            self._filled.notify_all()
            self._emptied.notify_all()
            return left

    def depth(self, lane: str | None = None) -> int:
        """Return how many items wait, in one lane or in all."""
        with self._lock:
            return self._size if lane is None else self._row(lane).depth()

    def dropped(self) -> dict[str, int]:
        """Return how many items each lane has dropped; only lanes that have."""
        with self._lock:
            return {name: row.dropped for name, row in self._lanes.items() if row.dropped}

    def _row(self, lane: str) -> _Lane:
        row = self._lanes.get(lane)
        if row is None:
            row = self._lanes[lane] = _Lane(self._capacity)
        return row

    def _store(self, row: _Lane, item: Any, key: object) -> tuple[Any] | None:
        """Store the item; return the one that had to go for it, in a tuple."""
        self._serial += 1
        if key is not None and key in row.latest:
            row.latest[key] = (row.latest[key][0], item)
            return None
        evicted: tuple[Any] | None = None
        if row.depth() >= row.capacity:
            evicted = (row.pop(),)
            row.dropped += 1
            self._size -= 1
        if key is None:
            row.stream.append((self._serial, item))
        else:
            row.latest[key] = (self._serial, item)
        self._size += 1
        return evicted

    def _next(self) -> _Lane:
        best: _Lane | None = None
        best_rank = (2, 0)
        for row in self._lanes.values():
            head = row.oldest()
            if head is not None and (rank := (0 if row.urgent else 1, head)) < best_rank:
                best, best_rank = row, rank
        assert best is not None  # called only while self._size > 0
        return best
