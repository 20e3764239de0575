"""The clocks of a process: monotonic time times out, UTC only labels. Tests bring their own."""

import time


class Clock:
    """The host's clocks."""

    def mono_ns(self) -> int:
        """Return monotonic time, ns: for ages, deadlines and latencies on this host."""
        return time.monotonic_ns()

    def utc_ns(self) -> int:
        """Return UTC, ns since 1970: a label for people and logs."""
        return time.time_ns()


class ManualClock(Clock):
    """A clock that stands still until it is advanced: for tests and for replays on the log's time."""

    def __init__(self, mono_ns: int = 1_000_000_000, utc_ns: int = 1_700_000_000_000_000_000) -> None:
        self._mono_ns, self._utc_ns = mono_ns, utc_ns

    def advance(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        self._mono_ns += round(seconds * 1e9)
        self._utc_ns += round(seconds * 1e9)

    def mono_ns(self) -> int:
        """Return the time set, ns."""
        return self._mono_ns

    def utc_ns(self) -> int:
        """Return the label set, ns."""
        return self._utc_ns
