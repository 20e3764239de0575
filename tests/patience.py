"""How long tests wait, and how they judge speed, on a machine that may stand still for a moment at any line."""

import time
from collections.abc import Callable

from rtkmesh_services.runtime.clock import Clock

PATIENCE_S = 60.0  # of a wait whose end matters only when all is broken
STAND_NS = 20_000_000  # longer than a loop that reads the clock ever lets pass by itself


def until(condition: Callable[[], object], *, step: Callable[[], object] = lambda: time.sleep(0.005)) -> None:
    """Return as soon as the condition holds; ``step`` lets the world go on meanwhile."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "waited in vain"
        step()


def shortest_s(act: Callable[[], object], enough_s: float, tries: int = 5) -> float:
    """Return the least time that ``act`` took in a few tries, the first below ``enough_s`` being the last.

    The machine's standing still makes one try slow, a fault makes all of them slow.
    """
    least_s = float("inf")
    for _ in range(tries):
        begun_s = time.monotonic()
        act()
        least_s = min(least_s, time.monotonic() - begun_s)
        if least_s < enough_s:
            break
    return least_s


def all_but_a_few(took_s: list[float]) -> float:
    """Return the longest of many durations but for five, in which the machine may have stood still."""
    return sorted(took_s)[-6]


class SteadyClock(Clock):
    """The host's clock without what passes while nobody reads it: no loop is late because the machine stood still."""

    def __init__(self) -> None:
        self._read_ns = self._now_ns = time.monotonic_ns()

    def mono_ns(self) -> int:
        """Return monotonic time, ns, of which each pause between two readings counts ``STAND_NS`` at most."""
        now_ns = time.monotonic_ns()
        self._now_ns += min(now_ns - self._read_ns, STAND_NS)
        self._read_ns = now_ns
        return self._now_ns
