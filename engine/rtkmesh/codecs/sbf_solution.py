"""The receiver's own solution, set-up and attitude from SBF (mosaic-X5 reference guide 4.14, 4.2.9 to 4.2.11 and 4.2.15)."""

from dataclasses import replace
from math import isfinite, nan, pi, radians, sqrt
from struct import Struct
from typing import Final

import numpy as np

from rtkmesh.codecs.rtcm3_station import printable
from rtkmesh.gnss.ephemeris import ReceiverFix, ReferenceStation
from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading
from rtkmesh.gnss.time import GpsTime

PVT_GEODETIC, RECEIVER_SETUP = "4007", "5902"
ATT_EULER, ATT_COV_EULER, AUX_POSITIONS, END_OF_ATT = "5938", "5939", "5942", "5943"
ATTITUDE: Final = frozenset((ATT_EULER, ATT_COV_EULER, AUX_POSITIONS, END_OF_ATT))

HEAD: Final = 14
_DO_NOT_USE: Final = -2e10
# Mode, Error, latitude, longitude (rad), height, undulation, velocity north, east, up, course, clock bias and drift, time system, datum,
# satellites, corrections; behind them, by revision: reference, age, signals, alert | bases, PPP | latency, accuracies, misc.
_PVT: Final = Struct("<BBdddfffffdfBBBB")
_PVT_ACCURACY: Final = Struct("<HHB")
_PVT_ACCURACY_AT: Final = 90
_SETUP: Final = Struct("<2x60s20s20s40s20s20s20s20s20sfff")
_EULER: Final = Struct("<BBHBxfff")
_COVARIANCE: Final = Struct("<xBfff")
_AUX: Final = Struct("<BBBBddd")

# PVT type -> fix of ReceiverFix.
_FIX_OF: Final = {1: 3, 2: 4, 3: 3, 4: 6, 5: 5, 6: 4, 7: 6, 8: 5, 10: 4}
_FIXED_LOCATION: Final = 3
_IS_ARP: Final = 1  # bits 6 and 7 of Misc: the marker is the antenna reference point
_NO_ACCURACY: Final = 65535
_NAMELESS: Final = ("unknown", "none", "")


def _value(number: float) -> float:
    """Return a number, NaN where the receiver has none."""
    return number if isfinite(number) and number > _DO_NOT_USE else nan


def read_fix(data: bytes, time: GpsTime | None) -> ReceiverFix | str:
    """Return the fix of a PVTGeodetic, or why it is refused; accuracies are sent as two sigma."""
    if len(data) < HEAD + _PVT.size:
        return "length"
    mode, error, lat, lon, height, _, north, east, up, _, _, _, _, _, satellites, _ = _PVT.unpack_from(data, HEAD)
    fix = 0 if error else _FIX_OF.get(mode & 15, 0)
    if mode & 0x80 and fix == 3:
        fix = 2
    lat_rad, lon_rad, height_m = _value(lat), _value(lon), _value(height)
    if fix and not (abs(lat_rad) <= 1.6 and abs(lon_rad) <= 6.3 and abs(height_m) < 1e8):
        return "value"
    velocity = _value(north), _value(east), -_value(up)
    return ReceiverFix(
        time, fix, lat_rad, lon_rad, height_m, *_accuracies(data), velocity if all(map(isfinite, velocity)) else None,
        0 if satellites == 255 else satellites,
    )  # fmt: skip


def _accuracies(data: bytes) -> tuple[float, float]:
    """Return horizontal and vertical sigma (m); blocks of old revisions have none."""
    if len(data) < _PVT_ACCURACY_AT + _PVT_ACCURACY.size:
        return nan, nan
    horizontal, vertical, _ = _PVT_ACCURACY.unpack_from(data, _PVT_ACCURACY_AT)
    return (nan if horizontal == _NO_ACCURACY else horizontal * 0.005), (nan if vertical == _NO_ACCURACY else vertical * 0.005)


class StationReader:
    """The receiver's own antenna: names and offsets by ReceiverSetup, the place by a PVTGeodetic of a fixed location (a base station)."""

    def __init__(self) -> None:
        self._station = ReferenceStation(0, source="sbf")
        self._offset_enu_m = (0.0, 0.0, 0.0)

    def setup(self, data: bytes) -> ReferenceStation | str | None:
        """Take a ReceiverSetup; return the station if it changed, None if not, or why the block is refused."""
        if len(data) < HEAD + _SETUP.size:
            return "length"
        *texts, up, east, north = _SETUP.unpack_from(data, HEAD)
        _, _, _, _, _, receiver, firmware, serial, antenna = (_text(text) for text in texts)
        if not all(abs(number) < 1e3 for number in (up, east, north)):
            return "value"
        self._offset_enu_m = (east, north, up)
        named = {"antenna": antenna, "antenna_serial": serial, "receiver": f"{receiver} {firmware}".strip()}
        return self._changed(replace(self._station, antenna_height_m=round(up, 4), **named))

    def fixed(self, data: bytes, fix: ReceiverFix) -> ReferenceStation | None:
        """Take a PVTGeodetic and its fix; return the station if its place is fixed and changed."""
        if data[HEAD] & 15 != _FIXED_LOCATION or not fix.fix:
            return None
        position = ecef_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m)
        is_arp = len(data) >= _PVT_ACCURACY_AT + 5 and data[_PVT_ACCURACY_AT + 4] >> 6 == _IS_ARP
        if not is_arp:
            position = position + enu_from_ecef(fix.lat_rad, fix.lon_rad).T @ np.array(self._offset_enu_m)
        x, y, z = (round(float(value), 4) for value in position)
        return self._changed(replace(self._station, position_ecef_m=(x, y, z)))

    def _changed(self, station: ReferenceStation) -> ReferenceStation | None:
        if station == self._station:
            return None
        self._station = station
        return station


def _text(text: bytes) -> str:
    """Return a text up to its first zero byte, empty where it says that nothing is known."""
    found = printable(text.split(b"\0")[0])
    return "" if found.lower() in _NAMELESS else found


class AttitudeReader:
    """Headings of receivers with several antennas, each with what the blocks behind it say: sigmas and the baseline.

    Of the blocks that come with an AttEuler those of the last epoch are waited for, until something else comes.
    """

    def __init__(self) -> None:
        self._held: ReceiverHeading | None = None
        self._last: GpsTime | None = None
        self._expected: set[str] = set()
        self._missing: set[str] = set()

    def take(self, kind: str, data: bytes, time: GpsTime | None) -> list[ReceiverHeading] | str:
        """Take a block of ATTITUDE; return the headings that are whole with it, or why it is refused."""
        if kind == ATT_EULER:
            return self._euler(data, time)
        if self._held is None or self._held.time != time:
            if kind != END_OF_ATT and time is not None and time == self._last:
                self._expected.add(kind)
            return self.flush()
        if kind == END_OF_ATT:
            return self.flush()
        found = _with_sigmas(self._held, data) if kind == ATT_COV_EULER else _with_baseline(self._held, data)
        if isinstance(found, str):
            return found
        self._held = found
        self._missing.discard(kind)
        return [] if self._missing else self._release()

    def flush(self) -> list[ReceiverHeading]:
        """Return the heading that still waits."""
        self._expected -= self._missing
        return self._release()

    def _release(self) -> list[ReceiverHeading]:
        held, self._held = self._held, None
        self._missing = set()
        return [] if held is None else [held]

    def _euler(self, data: bytes, time: GpsTime | None) -> list[ReceiverHeading] | str:
        waited = self.flush()
        if len(data) < HEAD + _EULER.size:
            return "length"
        self._held, self._last, self._missing = _heading(data, time), time, set(self._expected)
        return waited if self._missing else waited + self._release()


def _heading(data: bytes, time: GpsTime | None) -> ReceiverHeading:
    satellites, error, mode, _, heading, pitch, roll = _EULER.unpack_from(data, HEAD)
    solution = {1: CarrierSolution.FLOAT, 2: CarrierSolution.FIXED, 3: CarrierSolution.FLOAT, 4: CarrierSolution.FIXED}.get(mode)
    angles = (nan, nan, nan)
    if solution is not None and not error & 0x0F:  # errors of the baselines to both auxiliary antennas
        angles = _value(heading), _value(pitch), _value(roll) if mode >= 3 else nan
    heading_rad, pitch_rad, roll_rad = (radians(angle) for angle in angles)
    return ReceiverHeading(
        time, "AttEuler", solution or CarrierSolution.NONE, of_baseline=False, heading_rad=heading_rad % (2.0 * pi),
        pitch_rad=pitch_rad, roll_rad=roll_rad, satellites=None if satellites == 255 else satellites,
    )  # fmt: skip


def _with_sigmas(heading: ReceiverHeading, data: bytes) -> ReceiverHeading | str:
    if len(data) < HEAD + _COVARIANCE.size:
        return "length"
    error, *variances = _COVARIANCE.unpack_from(data, HEAD)
    sigmas = [radians(sqrt(v)) if v > 0.0 and isfinite(v) and not error & 0x0F else nan for v in variances]
    return replace(heading, heading_sigma_rad=sigmas[0], pitch_sigma_rad=sigmas[1], roll_sigma_rad=sigmas[2])


def _with_baseline(heading: ReceiverHeading, data: bytes) -> ReceiverHeading | str:
    """Add the place of the first auxiliary antenna from the main one."""
    at, size = HEAD + 2, 0 if len(data) < HEAD + 2 else data[HEAD + 1]
    if size < _AUX.size or at + data[HEAD] * size > len(data):
        return "length"
    for k in range(data[HEAD]):
        _, error, _, antenna, *offsets = _AUX.unpack_from(data, at + k * size)
        east, north, up = (_value(offset) for offset in offsets)
        if antenna == 1 and error == 0 and all(abs(offset) < 1e5 for offset in (east, north, up)):
            return replace(heading, baseline_ned_m=(north, east, -up), length_m=sqrt(east * east + north * north + up * up))
    return heading
