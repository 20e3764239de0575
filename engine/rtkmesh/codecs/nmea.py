"""NMEA 0183 sentences of a receiver. Version 4.11.

GGA is its fix; GST, RMC and VTG before it bring accuracy, date and velocity, ZDA the date. HDT and THS are headings, GSV and GSA the
satellites that it sees and uses. Also Unicore's answers to commands, which come in the form of a sentence:
``$command,MODE ROVER,response: OK``.
"""

from collections.abc import Callable
from math import cos, hypot, nan, pi, radians, sin
from typing import Final

from rtkmesh.codecs.messages import DecodingCounters, Frame, Message, Protocol
from rtkmesh.codecs.nmea_fields import degrees, number, time_of_day_s
from rtkmesh.codecs.nmea_satellites import SatelliteGatherer
from rtkmesh.codecs.utc import from_utc, gps_day, microseconds
from rtkmesh.gnss.constants import SECONDS_PER_DAY
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.receiver import CommandAnswer, ReceiverHeading
from rtkmesh.gnss.time import GpsTime

_FIX_OF_QUALITY: Final = {1: 3, 2: 4, 3: 3, 4: 6, 5: 5, 6: 1}
_ANSWER: Final = "command"
_DAY_US: Final = 86_400_000_000
_MPS_PER_KNOT: Final = 1852.0 / 3600.0
_MAX_ADDRESS: Final = 8


class NmeaDecoder:
    """Decodes the sentences of one receiver; GGA takes its date and its accuracy from what came before."""

    def __init__(self, approximate_time: GpsTime | None = None) -> None:
        self.counters = DecodingCounters()
        self._utc: tuple[int, int] | None = None  # newest time: days since the beginning of GPS time, microseconds of the day
        if approximate_time is not None:
            utc = approximate_time.to_utc()
            seconds = utc.hour * 3600 + utc.minute * 60 + utc.second
            self._utc = gps_day(utc.year, utc.month, utc.day), seconds * 1_000_000 + utc.microsecond
        self._sigmas: tuple[str, float, float] = ("", nan, nan)  # time of day, horizontal and vertical sigma (m)
        self._velocity: tuple[str, float, float] = ("", nan, nan)  # time of day, north and east (m/s)
        self._clock = ""  # newest time of day as sent
        self._satellites = SatelliteGatherer()
        self._readers: dict[str, Callable[[str, list[str]], Message | bool | None]] = {
            "GGA": self._gga, "GST": self._gst, "RMC": self._rmc, "VTG": self._vtg, "ZDA": self._zda, "HDT": self._hdt, "THS": self._ths,
            "GSV": self._gsv, "GSA": self._gsa,
        }  # fmt: skip

    def decode(self, frame: Frame) -> list[Message]:
        """Return what a sentence completes: a fix, a heading, the satellites in view, a receiver's answer."""
        if frame.kind == _ANSWER:
            return self._answer(frame)
        reader = self._readers.get(frame.kind[-3:])
        if reader is None or len(frame.kind) > _MAX_ADDRESS:
            self.counters.ignore(Protocol.NMEA, frame.kind)
            return []
        found = reader(frame.kind[:-3], frame.data[1 : frame.data.rfind(b"*")].decode("ascii", "replace").split(","))
        if found is False:
            self.counters.rejected[f"nmea/{frame.kind} field"] += 1
            return []
        self.counters.decoded[f"nmea/{frame.kind}"] += 1
        return [found] if not isinstance(found, bool) and found is not None else []

    def _answer(self, frame: Frame) -> list[Message]:
        text = frame.data[1 : frame.data.rfind(b"*")].decode("ascii", "replace")
        command, found, response = text.removeprefix(f"{_ANSWER},").partition(",response:")
        if not found:
            self.counters.rejected[f"nmea/{_ANSWER} field"] += 1
            return []
        self.counters.decoded[f"nmea/{_ANSWER}"] += 1
        response = response.strip()
        return [CommandAnswer(command, response.upper() == "OK", response)]

    def _rmc(self, _: str, fields: list[str]) -> bool:
        if len(fields) < 10:
            return False
        clock, date = time_of_day_s(fields[1]), fields[9]
        if clock is None or len(date) != 6 or not date.isdecimal():
            return fields[2] != "A"  # without a fix there need be no date
        if not self._set_date(2000 + int(date[4:]), date[2:4], date[:2], clock):
            return False
        self._clock = fields[1]
        self._set_velocity(number(fields[7]), number(fields[8]))
        return True

    def _zda(self, _: str, fields: list[str]) -> bool:
        if len(fields) < 5:
            return False
        clock = time_of_day_s(fields[1])
        if not all(field.isdecimal() and len(field) <= 4 for field in fields[2:5]) or clock is None:
            return not any(fields[1:5])
        self._clock = fields[1]
        return self._set_date(int(fields[4]), fields[3], fields[2], clock)

    def _set_date(self, year: int, month: str, day: str, clock_s: float) -> bool:
        try:
            self._utc = _later(gps_day(year, int(month), int(day)), clock_s)
        except ValueError:
            return False
        return True

    def _vtg(self, _: str, fields: list[str]) -> bool:
        if len(fields) < 8:
            return False
        self._set_velocity(number(fields[5]), number(fields[1]))
        return True

    def _set_velocity(self, knots: float | None, course_deg: float | None) -> None:
        """Take speed and course of the newest time; a receiver that stands still says no course."""
        if knots is not None and course_deg is not None:
            course_rad, speed_mps = radians(course_deg), knots * _MPS_PER_KNOT
            self._velocity = (self._clock, speed_mps * cos(course_rad), speed_mps * sin(course_rad))

    def _hdt(self, _: str, fields: list[str]) -> ReceiverHeading | bool:
        if len(fields) < 3:
            return False
        return self._heading("HDT", fields[1]) if fields[2] == "T" else False

    def _ths(self, _: str, fields: list[str]) -> ReceiverHeading | bool:
        """Only mode A is a measured heading (E is dead reckoning, M by hand, S simulated, V invalid)."""
        if len(fields) < 3:
            return False
        return self._heading("THS", fields[1] if fields[2] == "A" else "")

    def _heading(self, source: str, sent: str) -> ReceiverHeading | bool:
        """Return a heading with the newest time known, as the sentence has none; one that is not valid says so."""
        value = number(sent)
        if sent and (value is None or not -360.0 <= value <= 360.0):
            return False
        heading_rad = nan if value is None else radians(value) % (2.0 * pi)
        return ReceiverHeading(self._now(), source, None, of_baseline=False, heading_rad=heading_rad)

    def _gsv(self, talker: str, fields: list[str]) -> Message | bool | None:
        return self._satellites.gsv(talker, fields, self._now())

    def _now(self) -> GpsTime | None:
        """Return the newest time that a sentence had, None before the first one."""
        return from_utc(*self._utc) if self._clock and self._utc is not None else None

    def _gsa(self, talker: str, fields: list[str]) -> bool:
        return self._satellites.gsa(talker, fields)

    def _gst(self, _: str, fields: list[str]) -> bool:
        sigmas = [number(field) for field in fields[6:9]]
        if len(sigmas) < 3:
            return False
        north, east, up = sigmas
        if north is None or east is None or up is None:
            return True  # no fix
        self._sigmas = (fields[1], hypot(north, east), up)
        return True

    def _gga(self, _: str, fields: list[str]) -> ReceiverFix | bool:
        if len(fields) < 12 or not fields[6].isdecimal():
            return False
        lat, lon = degrees(fields[2], fields[3], 2, "NS"), degrees(fields[4], fields[5], 3, "EW")
        height, undulation = number(fields[9]), number(fields[11])
        satellites = int(fields[7]) if fields[7].isdecimal() else 0
        if lat is None or lon is None or height is None:
            return True  # the receiver has no fix
        same_epoch = self._sigmas[0] == fields[1]
        velocity = (self._velocity[1], self._velocity[2], nan) if self._velocity[0] == fields[1] else None
        return ReceiverFix(
            self._full_time(fields[1]), _FIX_OF_QUALITY.get(int(fields[6]), 0), radians(lat), radians(lon), height + (undulation or 0.0),
            self._sigmas[1] if same_epoch else nan, self._sigmas[2] if same_epoch else nan, velocity, satellites,
        )  # fmt: skip

    def _full_time(self, clock: str) -> GpsTime | None:
        """Return the GPS time of a UTC time of day: the one nearest to the last date known."""
        clock_s = time_of_day_s(clock)
        if clock_s is None:
            return None
        self._clock = clock
        if self._utc is None:
            return None
        day, time_of_day_us = self._utc
        self._utc = _later(day + round((time_of_day_us / 1e6 - clock_s) / SECONDS_PER_DAY), clock_s)
        return from_utc(*self._utc)


def _later(day: int, seconds: float) -> tuple[int, int]:
    """Return day and microseconds of the day of the instant so many seconds after a midnight (a leap second is the next day's first)."""
    days, time_of_day_us = divmod(microseconds(seconds), _DAY_US)
    return day + days, time_of_day_us
