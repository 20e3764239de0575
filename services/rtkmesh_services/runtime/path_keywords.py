"""RTKLIB's keywords in paths (``%Y%m%d_%h.ubx``), in GPS time, and when a file is to be swapped for the next one."""

import re
from datetime import UTC, datetime, timedelta
from math import floor
from typing import Final

from rtkmesh.gnss.time import GPS_ORIGIN, GpsTime

_KEYWORD: Final = re.compile(r"%(h[abc]|[YymdhMSnWDHt])")
_UNIX_ORIGIN: Final = datetime(1970, 1, 1, tzinfo=UTC)


def expanded(path: str, utc_ns: int) -> str:
    """Return a path with its keywords replaced by an instant; what is no keyword stays."""
    time = GpsTime.from_utc(_UNIX_ORIGIN + timedelta(microseconds=utc_ns // 1000))
    date, day = time.to_calendar(), int(time.tow_s // 86400)
    values = {
        **{name: date.strftime(form) for name, form in (("Y", "%Y"), ("y", "%y"), ("m", "%m"), ("d", "%d"), ("n", "%j"))},
        **{name: date.strftime(form) for name, form in (("h", "%H"), ("M", "%M"), ("S", "%S"))},
        **{name: f"{date.hour // hours * hours:02d}" for name, hours in (("ha", 3), ("hb", 6), ("hc", 12))},
        "W": f"{time.week:04d}",
        "D": str(day),
        "H": chr(ord("a") + date.hour),
        "t": f"{date.minute // 15 * 15:02d}",
    }
    return _KEYWORD.sub(lambda match: values[match[1]], path)


def swap_number(utc_ns: int, hours: float) -> int:
    """Return the number of the file that an instant falls into: they change at whole multiples of ``hours`` of GPS time. 0: never."""
    if hours <= 0.0:
        return 0
    time = GpsTime.from_utc(_UNIX_ORIGIN + timedelta(microseconds=utc_ns // 1000))
    return floor((time.to_calendar() - GPS_ORIGIN).total_seconds() / (hours * 3600.0))
