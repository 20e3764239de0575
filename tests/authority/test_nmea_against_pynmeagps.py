"""NMEA against pynmeagps, an independent parser: every sentence of the recordings, the same values."""

from collections import Counter
from io import BytesIO
from math import cos, degrees, isnan, radians, sin
from pathlib import Path
from typing import Any

import pytest
from pynmeagps import NMEAReader

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Message, Protocol
from rtkmesh.codecs.nmea import NmeaDecoder
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.receiver import SatelliteInView, SatellitesInView
from rtkmesh.gnss.signals import satellite_id

pytestmark = pytest.mark.data

LOGS = (
    "skytraq-dgps.log", "ublox-zed-f9p-nmea.log", "ublox-neo-m9n-nmea.log", "unicore-um621.log", "ublox-zed-f9r.log",
    "ublox-f9p-hpnmea.log", "nmea-rtk.log", "ublox-zed-f9p_hpg1.11.log",
)  # fmt: skip
READ = ("GGA", "GST", "RMC", "VTG", "ZDA", "GSV", "GSA", "HDT", "THS")
FIX_OF = {0: 0, 1: 3, 2: 4, 4: 6, 5: 5, 6: 1}
LETTERS = {"GP": "G", "GL": "R", "GA": "E", "GB": "C", "BD": "C", "GQ": "J", "QZ": "J"}


def frames_of(path: Path) -> list[Frame]:
    framer = Framer([Protocol.NMEA])
    return [
        frame for frame in framer.feed(path.read_bytes()[:400_000]) + framer.flush() if frame.kind[-3:] in READ and len(frame.kind) == 5
    ]


def parsed(frame: Frame) -> Any:
    data = frame.data if frame.data.endswith(b"\r\n") else frame.data[:-1] + b"\r\n"
    return NMEAReader(BytesIO(data), quitonerror=2).read()[1]


def name_of(talker: str, number: int) -> str:
    """Return the RINEX id of a satellite as NMEA 4.11 numbers it, with the numbers of SBAS, GLONASS and QZSS behind GP."""
    letter = LETTERS[talker]
    if letter == "G":
        letter, number = ("S", number - 13) if 33 <= number <= 64 else ("J", number - 192) if number >= 193 else (letter, number)
    elif letter == "R" and number > 64:
        number -= 64
    elif number > 300:
        number -= 300 if letter == "E" else 400
    elif letter == "C" and number > 200:
        number -= 200
    elif letter == "J" and number > 192:
        number -= 192
    return f"{letter}{number:02d}"


def assert_fix(fix: ReceiverFix, theirs: Any, rmc: Any) -> None:
    assert fix.fix == FIX_OF[theirs.quality]
    assert (degrees(fix.lat_rad), degrees(fix.lon_rad)) == pytest.approx((theirs.lat, theirs.lon), abs=1e-9)
    assert fix.height_m == pytest.approx(theirs.alt + (theirs.sep or 0.0), abs=1e-6)
    assert fix.satellites == theirs.numSV
    assert fix.time is not None
    assert abs((fix.time.to_utc().replace(tzinfo=None).time().second) - theirs.time.second) < 1
    if fix.velocity_ned_mps is not None and rmc is not None:
        course, speed = radians(float(rmc.cog)), float(rmc.spd) * 1852.0 / 3600.0
        assert fix.velocity_ned_mps[:2] == pytest.approx((speed * cos(course), speed * sin(course)), abs=1e-9)


def assert_view(view: SatellitesInView, cn0: dict[str, float], angles: dict[str, tuple[float, float]]) -> None:
    ours: dict[str, SatelliteInView] = {satellite_id(one.satellite): one for one in view.satellites}
    assert ours.keys() == cn0.keys()
    for name, one in ours.items():
        assert (0.0 if isnan(one.cn0_dbhz) else one.cn0_dbhz) == cn0[name]
        if not isnan(one.elevation_rad):
            assert (degrees(one.elevation_rad), degrees(one.azimuth_rad)) == pytest.approx(angles[name])


def satellites_in(message: Any) -> list[tuple[str, float, tuple[float, float]]]:
    """Return name, C/N0 (0: none), and elevation and azimuth of the satellites of a GSV."""
    found: list[tuple[str, float, tuple[float, float]]] = []
    for k in range(1, 5):
        number = getattr(message, f"svid_{k:02d}", "")
        if number != "" and number is not None:
            angles = tuple(float(getattr(message, f"{field}_{k:02d}") or 0.0) for field in ("elv", "az"))
            found.append((name_of(message.talker, int(number)), float(getattr(message, f"cno_{k:02d}") or 0.0), (angles[0], angles[1])))
    return found


@pytest.mark.parametrize("log", LOGS)
def test_sentences_mean_the_same(data: Path, log: str):
    """Fixes and satellites in view, sentence by sentence; nothing that pynmeagps reads is refused."""
    decoder, rmc = NmeaDecoder(), None
    cn0: dict[str, float] = {}
    angles: dict[str, tuple[float, float]] = {}
    begun: set[tuple[str, str]] = set()
    compared = Counter[str]()
    for frame in frames_of(data / "dec_gpsd" / log):
        theirs = parsed(frame)
        found: list[Message] = decoder.decode(frame)
        if theirs is None:  # a sentence that pynmeagps does not know
            compared["unknown"] += 1
            continue
        if theirs.msgID == "RMC":
            rmc = theirs if theirs.cog not in ("", None) else None
        elif theirs.msgID == "GGA" and found:
            (fix,) = found
            assert isinstance(fix, ReceiverFix)
            if fix.time is not None:
                assert_fix(fix, theirs, rmc)
                compared["GGA"] += 1
        elif theirs.msgID == "GSV":
            key = (theirs.talker, str(getattr(theirs, "signalID", "")))
            if theirs.msgNum == 1 and key in begun:
                (view,) = found
                assert isinstance(view, SatellitesInView)
                assert_view(view, cn0, angles)
                compared["GSV"] += 1
                cn0, angles, begun = {}, {}, set()
            begun.add(key)
            for name, strength, direction in satellites_in(theirs):
                cn0[name] = max(cn0.get(name, 0.0), strength)
                angles[name] = direction
    assert compared["unknown"] < 0.1 * decoder.counters.decoded.total()
    assert not decoder.counters.rejected
    assert compared["GGA"] >= 5
    assert compared["GSV"] >= 5 or "GSV" not in {kind[-3:] for kind in decoder.counters.decoded}
