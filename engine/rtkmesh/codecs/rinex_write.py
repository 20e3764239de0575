"""What the headers of the RINEX files that we write share (RINEX 3.05 appendix A, RINEX 4.00 appendix A)."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime

from rtkmesh.gnss.time import GpsTime


@dataclass(frozen=True, slots=True)
class Origin:
    """Who makes a file, when (UTC), of what. ``version`` is 3.05 or 4.00."""

    version: float
    program: str
    date: datetime
    comments: tuple[str, ...] = ()


def header_line(content: str, label: str) -> str:
    """Return one line of a header; content that is too long is cut."""
    return f"{content[:60]:<60}{label}\n"


def first_lines(origin: Origin, kind: str) -> str:
    """Return the lines that every file begins with."""
    version = header_line(f"{origin.version:9.2f}{'':11}{kind:<20}{'M: MIXED':<20}", "RINEX VERSION / TYPE")
    maker = header_line(f"{origin.program:<20.20}{'':20}{origin.date:%Y%m%d %H%M%S} UTC", "PGM / RUN BY / DATE")
    return version + maker + comment_lines(origin.comments)


def comment_lines(comments: Iterable[str]) -> str:
    """Return comments, one line each, printable ASCII only."""
    return "".join(header_line("".join(c if 32 <= ord(c) < 127 else "?" for c in text), "COMMENT") for text in comments)


def calendar_fields(time: GpsTime, digits: int) -> tuple[int, int, int, int, int, int, int]:
    """Return year, month, day, hour, minute, second and the rest in units of 10^-digits s of a GPS instant, rounded to them."""
    unit = 10**digits
    ticks = round(time.tow_s * unit)
    calendar = GpsTime.normalized(time.week, float(ticks // unit)).to_calendar()
    return calendar.year, calendar.month, calendar.day, calendar.hour, calendar.minute, calendar.second, ticks % unit
