"""A filter's recent past: what was done to its state and when, so that a late input can take its place."""

from bisect import bisect_right
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar


class Timed(Protocol):
    """A state of a filter at its time (s)."""

    @property
    def time_s(self) -> float:
        """Its time, on the filter's own scale."""
        ...


S = TypeVar("S", bound=Timed)


class Timeline(Generic[S]):
    """States in the order of their times, each with the step that made it of the state before."""

    def __init__(self, first: S, history_s: float) -> None:
        """``history_s``: how much of the past is kept behind the newest state."""
        self._history_s = history_s
        self._times_s, self._states = [first.time_s], [first]
        self._steps: list[Callable[[S], S] | None] = [None]

    @property
    def newest(self) -> S:
        """The last state."""
        return self._states[-1]

    def before(self, time_s: float) -> S | None:
        """Return the last state that is not after this time; None when the past is not kept that far."""
        index = bisect_right(self._times_s, time_s)
        return self._states[index - 1] if index else None

    def insert(self, state: S, step: Callable[[S], S]) -> None:
        """Put a step in its place: ``state`` is what it makes of the state before; what came after is done again."""
        index = bisect_right(self._times_s, state.time_s)
        self._times_s.insert(index, state.time_s)
        self._states.insert(index, state)
        self._steps.insert(index, step)
        for later in range(index + 1, len(self._states)):
            again = self._steps[later]
            assert again is not None
            self._states[later] = again(self._states[later - 1])
        self._forget()

    def _forget(self) -> None:
        """Drop what is older than the history, but for the last state before it."""
        count = bisect_right(self._times_s, self._times_s[-1] - self._history_s) - 1
        if count > 0:
            del self._times_s[:count], self._states[:count], self._steps[:count]
