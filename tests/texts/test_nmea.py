"""Sentences: what NMEA 0183 means, where RTKLIB writes something else, and 2.4.2's; read by pynmeagps."""

from dataclasses import replace
from math import atan2, degrees, nan, pi, radians, sqrt
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from pynmeagps import NMEAReader
from tests.texts.solutions import Drawn, drawn, ecef, message, sentences, table
from tests.texts.test_lines import SOLUTION, vector_to_ecef

from rtkmesh_services.texts import TextOptions, TextWriter
from rtkmesh_services.texts.sky import Satellite, dops

SKY = table(
    [
        ("G01", "1C", 7, 0.0, 90.0, 45.0),
        ("G01", "2W", 0, 0.0, 90.0, 30.0),
        ("G02", "1C", 3, 0.0, 20.0, 40.0),
        ("R03", "1C", 3, 120.0, 20.0, 41.0),
        ("E05", "1C", 1, 240.0, 20.0, nan),
        ("J02", "1C", 0, 359.7, 33.0, 38.0),
        ("S20", "1C", 0, 180.0, -3.0, 38.0),
    ]
)


def parsed(options: TextOptions, solution: Any = SOLUTION, satellites: Any = SKY) -> dict[str, Any]:
    """Return the sentences of an epoch as pynmeagps reads them, by their kind; the last of a kind."""
    text = TextWriter(options).epoch(solution, satellites)
    return {line[3:6].decode(): NMEAReader.parse(line + b"\r\n", validate=1) for line in text.split(b"\r\n") if line}


def test_order_of_sentences() -> None:
    """RMC, GGA, GST, then GSA and GSV of each system with RTKLIB's talkers."""
    text = TextWriter(sentences()).text(SOLUTION, SKY)
    kinds = [line[1:6] for line in text.splitlines()]
    assert kinds == ["GPRMC", "GPGGA", "GPGST", "GNGSA", "GNGSA", "GNGSA", "GPGSV", "GLGSV", "GAGSV", "GQGSV"]
    assert TextWriter(sentences(talker="GN")).text(SOLUTION).startswith("$GNRMC")


def test_hdop_is_that_of_the_satellites() -> None:
    """One at the zenith and three at 20 degrees, 120 degrees apart: east and north variances are 1 / (1.5 cos² 20°) each."""
    expected = sqrt(2.0 / (1.5 * 0.883022))
    found = parsed(sentences())
    assert round(expected, 1) == found["GGA"].HDOP
    assert round(expected, 1) == found["GSA"].HDOP
    assert pytest.approx(sqrt(1.0 / (3.0 * (0.65798**2) * 0.25)), abs=0.06) == found["GSA"].VDOP


def test_unknown_fields_are_empty() -> None:
    """Without satellites there is no HDOP; a single point has no age and no station; without a velocity there is no course."""
    single = msgspec.structs.replace(SOLUTION, status=5, velocity_ecef_mps=(nan,) * 3)
    rmc, gga, *_ = TextWriter(sentences()).text(single).splitlines()
    assert gga.split(",")[8] == ""
    assert gga.split(",")[13:] == ["", "*" + gga[-2:]]
    assert rmc.split(",")[7:9] == ["", ""]


@pytest.mark.parametrize(("status", "quality", "mode"), [(1, 4, "R"), (2, 5, "F"), (3, 2, "D"), (4, 2, "D"), (5, 1, "A"), (6, 3, "P")])
def test_quality(status: int, quality: int, mode: str) -> None:
    """Floats are F in RMC, solutions by SBAS are differential in GGA: NMEA 0183 4.11."""
    found = parsed(sentences(), msgspec.structs.replace(SOLUTION, status=status))
    assert (found["GGA"].quality, found["RMC"].posMode) == (quality, mode)


def test_rtklibs_habits() -> None:
    """With them HDOP is 1.0, the speed that in space, the variation 0 east, and GST's root mean square 0."""
    fast = msgspec.structs.replace(SOLUTION, velocity_ecef_mps=vector_to_ecef(3.0, 0.0, 4.0), code_rms_m=0.5)
    rmc, gga, gst = TextWriter(sentences(nmea="rtklib")).text(fast).splitlines()
    assert gga.split(",")[8] == "1.0"
    assert rmc.split(",")[7:11] == [f"{5.0 / 0.514444444:.2f}", "90.00", "190321", "0.0"]
    assert gst.split(",")[2] == "0.000"
    right = parsed(sentences(), fast)
    assert right["RMC"].spd == pytest.approx(3.0 / 0.514444444, abs=0.005)
    assert right["GST"].rangeRms == 0.5


def test_ellipse() -> None:
    """The half axes are the roots of the horizontal covariance's eigenvalues."""
    gst = parsed(sentences())["GST"]
    east, north, mixed = 0.0033**2, 0.0034**2, -(0.0014**2)
    spread = sqrt(((north - east) / 2.0) ** 2 + mixed**2)
    assert gst.stdMajor == round(sqrt((north + east) / 2.0 + spread), 3)
    assert gst.stdMinor == round(sqrt((north + east) / 2.0 - spread), 3)
    assert gst.orient == round(degrees(atan2(mixed, (north - east) / 2.0) / 2.0) % 180.0, 1)
    assert (gst.stdLat, gst.stdLong, gst.stdAlt) == (0.003, 0.003, 0.007)


@settings(max_examples=100)
@given(numbers=drawn())
def test_read_by_pynmeagps(numbers: Drawn) -> None:
    """What pynmeagps reads of any solution is the solution, and minutes are never 60."""
    solution = numbers.message()
    text = TextWriter(sentences()).text(solution)
    assert "60.0000000" not in text
    if not text:
        assert numbers.status == 0
        return
    gga = NMEAReader.parse(text.splitlines(keepends=True)[1].encode())
    x, y, z = ecef(gga.lat, gga.lon, gga.alt + gga.sep)
    assert (x, y, z) == pytest.approx(numbers.position_ecef_m, abs=2e-3)


def test_minutes_are_never_sixty() -> None:
    """59.99999999 minutes are the next degree; RTKLIB prints 60.0000000."""
    there = message(position_ecef_m=ecef(34.9999999999, 139.9999999999, 0.0))
    assert ",3500.0000000,N,14000.0000000,E," in TextWriter(sentences()).text(there)


def test_intervals() -> None:
    """Position and satellites have intervals of their own; a negative one is never."""
    writer = TextWriter(sentences(interval_s=5.0, satellites_interval_s=-1.0))
    told = [bool(writer.text(msgspec.structs.replace(SOLUTION, tow_s=100.0 + k * 0.2), SKY)) for k in range(51)]
    assert [k for k, one in enumerate(told) if one] == [0, 25, 50]
    assert "GSA" not in TextWriter(sentences(satellites_interval_s=-1.0)).text(SOLUTION, SKY)


def test_more_than_twelve_satellites() -> None:
    """A second GSA tells the others; RTKLIB leaves them out."""
    many = table([(f"G{k:02d}", "1C", 3, 20.0 * k, 30.0 + k, 40.0) for k in range(1, 16)])
    right, theirs = (TextWriter(sentences(nmea=rule)).text(SOLUTION, many) for rule in ("nmea", "rtklib"))
    assert [line.split(",")[3] for line in right.splitlines() if "GSA" in line] == ["01", "13"]
    assert theirs.count("GSA") == 1


def test_satellites_in_view() -> None:
    """Numbers as NMEA has them, azimuth below 360, C/N0 only of what is tracked; below the horizon nothing is in view."""
    lines = [line for line in TextWriter(sentences()).text(SOLUTION, SKY).splitlines() if "GSV" in line]
    assert lines[0].startswith("$GPGSV,1,1,02,01,90,000,45,02,20,000,40,,,,,,,,,0*")
    assert lines[1].startswith("$GLGSV,1,1,01,67,20,120,41,")
    assert lines[2].startswith("$GAGSV,1,1,01,05,20,240,,")
    assert lines[3].startswith("$GQGSV,1,1,01,02,33,000,38,")
    assert len(lines) == 4


def test_sentences_of_242() -> None:
    """2.4.2: twelve fields of RMC, no station in GGA, no GST, DOPs per system, views of the used with signal ids."""
    text = TextWriter(sentences(nmea="rtklib", dialect="2.4")).text(SOLUTION, SKY)
    lines = text.splitlines()
    assert [line[1:6] for line in lines] == ["GPRMC", "GPGGA", "GPGSA", "GLGSA", "GAGSA", "GPGSV", "GLGSV", "GAGSV"]
    assert lines[0].split("*")[0].endswith(",0.0,E,D")
    assert lines[1].split("*")[0].endswith(",0.0,")
    assert lines[2].split("*")[0].endswith(",0.0,0.0,0.0,1")
    assert lines[7].split("*")[0].endswith(",7")
    none = TextWriter(sentences(nmea="rtklib", dialect="2.4")).text(msgspec.structs.replace(SOLUTION, status=0), SKY)
    assert none == "$GPGSA,A,1,,,,,,,,,,,,,,,*1E\r\n$GPGSV,1,1,0,,,,,,,,,,,,,,,,*49\r\n"


def test_dops_of_a_flat_geometry() -> None:
    """Satellites in one cone, or fewer than four, have no DOPs."""
    cone = [Satellite(f"G{k:02d}", 60.0 * k, 40.0, 45.0, True) for k in range(6)]
    assert all(value != value for value in (*dops(cone), *dops(cone[:3])))
    assert all(value == value for value in dops([*cone, cone[0]._replace(elevation_deg=89.0)]))
    assert radians(180.0) == pi


def test_options_do_not_mix() -> None:
    """Two writers hold their own courses."""
    fast, slow = (msgspec.structs.replace(SOLUTION, velocity_ecef_mps=vector_to_ecef(speed, 0.0, 0.0)) for speed in (10.0, 0.1))
    one, other = TextWriter(sentences()), TextWriter(replace(sentences(), talker="GN"))
    one.text(fast)
    assert ",90.00," in one.text(slow).splitlines()[0]
    assert ",90.00," not in other.text(slow).splitlines()[0]
