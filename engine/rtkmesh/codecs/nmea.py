"""NMEA 0183 sentences that tell a receiver's own fix: GGA (position), GST (its accuracy), RMC (the date). Version 4.11."""

from math import hypot, isfinite, radians
from typing import Final

from rtkmesh.codecs.messages import DecodingCounters, Frame, Message
from rtkmesh.codecs.utc import from_utc, gps_day, microseconds
from rtkmesh.gnss.constants import SECONDS_PER_DAY
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.time import GpsTime

_FIX_OF_QUALITY: Final = {1: 3, 2: 4, 3: 3, 4: 6, 5: 5, 6: 1}
_DECODED: Final = frozenset(("GGA", "GST", "RMC"))
_DAY_US: Final = 86_400_000_000
_NAN: Final = float("nan")
_MAX_KINDS: Final = 1000  # sentences with a counter of their own


class NmeaDecoder:
    """Decodes the sentences of one receiver; GGA takes its date and its accuracy from what came before."""

    def __init__(self, approximate_time: GpsTime | None = None) -> None:
        self.counters = DecodingCounters()
        self._utc: tuple[int, int] | None = None  # newest time: days since the beginning of GPS time, microseconds of the day
        if approximate_time is not None:
            utc = approximate_time.to_utc()
            seconds = utc.hour * 3600 + utc.minute * 60 + utc.second
            self._utc = gps_day(utc.year, utc.month, utc.day), seconds * 1_000_000 + utc.microsecond
        self._sigmas: tuple[str, float, float] = ("", _NAN, _NAN)  # time of day, horizontal and vertical sigma (m)

    def decode(self, frame: Frame) -> list[Message]:
        """Return the receiver's fix if this is a GGA sentence."""
        sentence = frame.kind[-3:]
        if sentence not in _DECODED:
            known = len(self.counters.ignored) < _MAX_KINDS
            self.counters.ignored[f"nmea/{frame.kind}" if known else "nmea/other"] += 1
            return []
        fields = frame.data[1 : frame.data.rfind(b"*")].decode("ascii", "replace").split(",")
        if sentence == "GGA":
            fix = self._gga(fields)
        elif sentence == "RMC":
            fix = self._rmc(fields)
        else:
            fix = self._gst(fields)
        if fix is False:
            self.counters.rejected[f"nmea/{frame.kind} field"] += 1
            return []
        self.counters.decoded[f"nmea/{frame.kind}"] += 1
        return [fix] if isinstance(fix, ReceiverFix) else []

    def _rmc(self, fields: list[str]) -> bool:
        if len(fields) < 10:
            return False
        clock, date = _time_of_day_s(fields[1]), fields[9]
        if clock is None or len(date) != 6 or not date.isdecimal():
            return fields[2] != "A"  # without a fix there need be no date
        try:
            day = gps_day(2000 + int(date[4:]), int(date[2:4]), int(date[:2]))
        except ValueError:
            return False
        self._utc = _later(day, clock)
        return True

    def _gst(self, fields: list[str]) -> bool:
        sigmas = [_number(field) for field in fields[6:9]]
        if len(sigmas) < 3:
            return False
        north, east, up = sigmas
        if north is None or east is None or up is None:
            return True  # no fix
        self._sigmas = (fields[1], hypot(north, east), up)
        return True

    def _gga(self, fields: list[str]) -> ReceiverFix | bool:
        if len(fields) < 12 or not fields[6].isdecimal():
            return False
        lat, lon = _degrees(fields[2], fields[3], 2, "NS"), _degrees(fields[4], fields[5], 3, "EW")
        height, undulation = _number(fields[9]), _number(fields[11])
        satellites = int(fields[7]) if fields[7].isdecimal() else 0
        if lat is None or lon is None or height is None:
            return True  # the receiver has no fix
        same_epoch = self._sigmas[0] == fields[1]
        return ReceiverFix(
            self._full_time(fields[1]), _FIX_OF_QUALITY.get(int(fields[6]), 0), radians(lat), radians(lon), height + (undulation or 0.0),
            self._sigmas[1] if same_epoch else _NAN, self._sigmas[2] if same_epoch else _NAN, None, satellites,
        )  # fmt: skip

    def _full_time(self, clock: str) -> GpsTime | None:
        """Return the GPS time of a UTC time of day: the one nearest to the last date known."""
        clock_s = _time_of_day_s(clock)
        if clock_s is None or self._utc is None:
            return None
        day, time_of_day_us = self._utc
        self._utc = _later(day + round((time_of_day_us / 1e6 - clock_s) / SECONDS_PER_DAY), clock_s)
        return from_utc(*self._utc)


def _later(day: int, seconds: float) -> tuple[int, int]:
    """Return day and microseconds of the day of the instant so many seconds after a midnight (a leap second is the next day's first)."""
    days, time_of_day_us = divmod(microseconds(seconds), _DAY_US)
    return day + days, time_of_day_us


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None


def _time_of_day_s(text: str) -> float | None:
    """Return the seconds of ``hhmmss.ss``."""
    seconds = _number(text[4:])
    if not text[:4].isdecimal() or seconds is None:
        return None
    hour, minute = int(text[:2]), int(text[2:4])
    return hour * 3600.0 + minute * 60.0 + seconds if hour < 24 and minute < 60 and 0.0 <= seconds < 61.0 else None


def _degrees(text: str, side: str, digits: int, sides: str) -> float | None:
    """Return degrees of ``dddmm.mmmm`` and a hemisphere letter."""
    minutes = _number(text[digits:])
    if not text[:digits].isdecimal() or minutes is None or side not in sides or len(side) != 1:
        return None
    value = int(text[:digits]) + minutes / 60.0
    if not 0.0 <= minutes < 60.0 or value > (90.0 if digits == 2 else 180.0):
        return None
    return -value if side == sides[1] else value
