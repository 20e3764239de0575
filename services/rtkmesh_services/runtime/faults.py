"""The newest faults of a process, for the word ``error``: bounded, from any thread."""

from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

from rtkmesh.gnss.time import GpsTime

KEPT: Final = 256
SHOWN: Final = 20  # in an answer that is asked for without a number
_UNIX_ORIGIN: Final = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Fault:
    """What was wrong, and when (``yyyy/mm/dd hh:mm:ss.ss``, GPS time)."""

    time: str
    level: str
    code: str
    text: str

    @property
    def line(self) -> str:
        """The fault on a line, as RTKRCV shows it."""
        return f"{self.time}: {self.text}".replace("\n", " ")


class Faults:
    """The newest faults; ``total`` counts all that there were."""

    def __init__(self) -> None:
        self.total = 0
        self._kept: deque[Fault] = deque(maxlen=KEPT)

    def add(self, fault: Fault) -> None:
        """Take one."""
        self._kept.append(fault)
        self.total += 1

    def newest(self, count: int) -> list[Fault]:
        """Return the newest, oldest first."""
        return list(self._kept)[-count:] if count > 0 else []


def time_of(time: GpsTime) -> str:
    """Return a GPS time as faults have it."""
    calendar = time.to_calendar()
    return f"{calendar:%Y/%m/%d %H:%M:%S}.{calendar.microsecond // 10000:02d}"


def time_of_utc(utc_ns: int) -> str:
    """Return a host's time as faults have it."""
    return time_of(GpsTime.from_utc(_UNIX_ORIGIN + timedelta(microseconds=utc_ns // 1000)))
