"""NMEA 0183 GSV and GSA to the satellites that a receiver sees and uses. Version 4.11."""

from dataclasses import replace
from math import nan, radians
from typing import Final

from rtkmesh.codecs.nmea_fields import number
from rtkmesh.gnss.receiver import SatelliteInView, SatellitesInView
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NAVIC, QZSS, SATELLITES_PER_SYSTEM, SBAS
from rtkmesh.gnss.time import GpsTime

# First and last number as sent, system, difference from the satellite's own number. Ranges above 100 are those of several makers.
_OF_ANY: Final = (
    (1, 32, GPS, 0), (33, 64, SBAS, 13), (65, 96, GLONASS, 64), (120, 158, SBAS, 100), (193, 202, QZSS, 192), (201, 263, BEIDOU, 200),
    (301, 336, GALILEO, 300), (401, 463, BEIDOU, 400),
)  # fmt: skip
# What the small numbers mean behind a talker, or with a system identifier in GSA.
_OF_TALKER: Final = {
    "GL": ((1, 32, GLONASS, 0),), "GA": ((1, 36, GALILEO, 0),), "GB": ((1, 63, BEIDOU, 0),), "BD": ((1, 63, BEIDOU, 0),),
    "GQ": ((1, 10, QZSS, 0),), "QZ": ((1, 10, QZSS, 0),), "GI": ((1, 14, NAVIC, 0),),
}  # fmt: skip
_TALKER_OF_SYSTEM_ID: Final = {"1": "GP", "2": "GL", "3": "GA", "4": "GB", "5": "GQ", "6": "GI"}
_ACQUIRED, _CODE, _SEARCHING = 2, 4, 1  # qualities of SatelliteInView
_MAX_SATELLITES: Final = 512  # of one cycle: a hostile stream must not fill memory


def satellite_of(talker: str, sent: str) -> int | None:
    """Return the satellite of a number behind a talker, None if there is none."""
    if not (sent.isdecimal() and len(sent) <= 3):
        return None
    for first, last, system, offset in (*_OF_TALKER.get(talker, ()), *_OF_ANY):
        if first <= int(sent) <= last:
            return system * SATELLITES_PER_SYSTEM + int(sent) - offset
    return None


class SatelliteGatherer:
    """Gathers the sentences of one cycle: they begin again when the first one of a talker and signal comes a second time."""

    def __init__(self) -> None:
        self._seen: set[tuple[str, str]] = set()  # talker and signal of this cycle's sentences
        self._satellites: dict[int, SatelliteInView] = {}
        self._used: dict[tuple[str, str], set[int]] = {}  # by talker and system
        self._last_gsa: tuple[str, str] | None = None
        self._time: GpsTime | None = None

    def gsv(self, talker: str, fields: list[str], time: GpsTime | None) -> SatellitesInView | bool | None:
        """Take a GSV; return the cycle that ended with it, None, or False if the sentence is none."""
        self._last_gsa = None
        if len(fields) < 4 or not (fields[1].isdecimal() and fields[2].isdecimal() and 1 <= int(fields[2]) <= int(fields[1])):
            return False
        signal = fields[-1] if len(fields) % 4 == 1 else ""
        done: SatellitesInView | None = None
        if int(fields[2]) == 1:
            if (talker, signal) in self._seen:
                done = self._finish()
            if not self._seen:
                self._time = time
            self._seen.add((talker, signal))
        for at in range(4, len(fields) - 3, 4):
            self._add(talker, fields[at : at + 4])
        return done

    def gsa(self, talker: str, fields: list[str]) -> bool:
        """Take a GSA: satellites in use. Several in a row of one system belong together."""
        if len(fields) < 18:
            return False
        key = (talker, fields[18] if len(fields) > 18 else "")
        used = self._used.setdefault(key, set()) if len(self._used) < _MAX_SATELLITES else set[int]()
        if self._last_gsa != key:
            used.clear()
        self._last_gsa = key
        for sent in fields[3:15]:
            satellite = satellite_of(_TALKER_OF_SYSTEM_ID.get(key[1], talker), sent)
            if satellite is not None:
                used.add(satellite)
        return True

    def _add(self, talker: str, fields: list[str]) -> None:
        satellite = satellite_of(talker, fields[0])
        if satellite is None or len(self._satellites) >= _MAX_SATELLITES:
            return
        cn0 = number(fields[3])
        elevation_rad, azimuth_rad = (nan if (angle := number(text)) is None else radians(angle) for text in fields[1:3])
        new = SatelliteInView(
            satellite, nan if cn0 is None else cn0, elevation_rad, azimuth_rad, nan, _SEARCHING if cn0 is None else _ACQUIRED,
            used=False, healthy=None, corrected=False,
        )  # fmt: skip
        known = self._satellites.get(satellite)
        if known is None or not new.cn0_dbhz <= known.cn0_dbhz:
            self._satellites[satellite] = new if known is None or cn0 is not None else known

    def _finish(self) -> SatellitesInView:
        """Return the cycle and begin anew."""
        used = set[int]().union(*self._used.values())
        found = tuple(
            replace(one, used=True, quality=_CODE) if number in used else one for number, one in sorted(self._satellites.items())
        )  # fmt: skip
        self._seen.clear()
        self._satellites = {}
        return SatellitesInView(self._time, found)
