"""NMEA sentences to the receiver's own fix."""

from math import cos, isnan, nan, radians, sin
from math import degrees as degrees_of

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.nmea import NmeaDecoder
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.receiver import ReceiverHeading, SatellitesInView
from rtkmesh.gnss.signals import satellite_id
from rtkmesh.gnss.time import GpsTime


def frame(text: str) -> Frame:
    return Frame(Protocol.NMEA, text.split(",", maxsplit=1)[0], f"${text}*00\r\n".encode())


def fix_of(decoder: NmeaDecoder, text: str) -> ReceiverFix:
    (message,) = decoder.decode(frame(text))
    assert isinstance(message, ReceiverFix)
    return message


GGA = "GNGGA,125000.20,5218.0000,N,01330.6000,W,{quality},12,0.8,100.5,M,39.5,M,,"


@pytest.mark.parametrize(("quality", "fix"), [(0, 0), (1, 3), (2, 4), (4, 6), (5, 5), (6, 1), (9, 0)])
def test_gga_gives_position_and_kind_of_fix(quality: int, fix: int):
    """Degrees and minutes, hemispheres, ellipsoidal height; without a date no time."""
    message = fix_of(NmeaDecoder(), GGA.format(quality=quality))
    assert (message.fix, message.satellites, message.time, message.height_m) == (fix, 12, None, 140.0)
    assert (message.lat_rad, message.lon_rad) == (pytest.approx(radians(52.3)), pytest.approx(radians(-13.51)))


def test_date_and_accuracy_come_from_the_sentences_before():
    """RMC brings the day, GST the accuracy of the same second."""
    decoder = NmeaDecoder()
    assert decoder.decode(frame("GNRMC,125000.20,A,5218.0,N,01330.6,W,0.1,,200125,,,A")) == []
    assert decoder.decode(frame("GNGST,125000.20,1.0,,,,3.0,4.0,7.0")) == []
    message = fix_of(decoder, GGA.format(quality=4))
    assert message.time is not None
    assert message.time - GpsTime(2350, 132_618.2) == pytest.approx(0.0, abs=1e-6)
    assert (message.horizontal_sigma_m, message.vertical_sigma_m) == (5.0, 7.0)
    assert fix_of(decoder, GGA.format(quality=4).replace("125000.20", "125001.20")).vertical_sigma_m != 7.0


def test_midnight_between_rmc_and_gga_changes_the_day():
    """The day is the one that brings the time of day nearest."""
    decoder = NmeaDecoder()
    decoder.decode(frame("GNRMC,235959.80,A,5218.0,N,01330.6,W,0.1,,200125,,,A"))
    message = fix_of(decoder, GGA.format(quality=4).replace("125000.20", "000000.00"))
    assert message.time is not None
    assert message.time - GpsTime(2350, 2 * 86_400.0 + 18.0) == pytest.approx(0.0, abs=1e-6)


def test_the_approximate_time_serves_as_a_date():
    """Without RMC the caller's time decides the day."""
    message = fix_of(NmeaDecoder(GpsTime(2350, 132_000.0)), GGA.format(quality=1))
    assert message.time == GpsTime.normalized(2350, 132_618.2)


@pytest.mark.parametrize(
    "text",
    ["GNGGA,,,,,,0,00,99.99,,,,,,", "GNGST,125000.20,,,,,,,", "GNRMC,,V,,,,,,,,,,N"],
)
def test_sentences_without_a_fix_give_nothing_and_are_no_fault(text: str):
    """A receiver that has not found its place yet."""
    decoder = NmeaDecoder()
    assert decoder.decode(frame(text)) == []
    assert sum(decoder.counters.rejected.values()) == 0


@given(sentence=st.sampled_from(["GNGGA", "GPRMC", "GNGST", "GA"]), text=st.text("0123456789.,-NSEWAVnaif", max_size=70))
@settings(max_examples=150, deadline=None)
def test_random_fields_never_raise(sentence: str, text: str):
    """Whatever stands between the commas."""
    decoder = NmeaDecoder(GpsTime(2350, 0.0))
    decoder.decode(frame(f"{sentence},{text}"))
    decoder.decode(frame(f"{sentence},120000,{text}"))


def test_other_sentences_are_counted_as_ignored():
    """They are passed on raw."""
    decoder = NmeaDecoder()
    assert decoder.decode(frame("GNGLL,5218.0,N,01330.6,W,125000.20,A,A")) == []
    assert decoder.counters.ignored == {"nmea/GNGLL": 1}


def heading_of(decoder: NmeaDecoder, text: str) -> ReceiverHeading:
    (message,) = decoder.decode(frame(text))
    assert isinstance(message, ReceiverHeading)
    return message


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        ("GNHDT,123.456,T", 123.456), ("HEHDT,359.9,T", 359.9), ("GNTHS,271.5,A", 271.5), ("GNTHS,271.5,E", nan), ("GNTHS,271.5,M", nan),
        ("GNTHS,271.5,V", nan), ("GNTHS,,V", nan), ("GNHDT,,T", nan),
    ],
)  # fmt: skip
def test_headings_are_valid_or_nan(text: str, degrees: float):
    """Of THS only mode A is a measurement. They are of the vehicle, and without a sentence with a time they have none."""
    heading = heading_of(NmeaDecoder(GpsTime(2350, 0.0)), text)
    assert (heading.source, heading.of_baseline, heading.solution, heading.time) == (text[2:5], False, None, None)
    assert degrees_of(heading.heading_rad) == pytest.approx(degrees, nan_ok=True)


def test_a_heading_has_the_time_of_the_sentence_before():
    decoder = NmeaDecoder()
    decoder.decode(frame("GNZDA,125000.20,20,01,2025,00,00"))
    time = heading_of(decoder, "GNHDT,10.0,T").time
    assert time is not None
    assert time - GpsTime(2350, 132_618.2) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("text", ["GNHDT,x,T", "GNHDT,10.0,M", "GNHDT,1000.0,T", "GNTHS,10.0", "GNZDA,125000,32,01,2025,0,0", "GNVTG,1,T"])
def test_damaged_fields_are_refused(text: str):
    decoder = NmeaDecoder()
    assert decoder.decode(frame(text)) == []
    assert decoder.counters.rejected == {f"nmea/{text[:5]} field": 1}


@pytest.mark.parametrize(
    "text",
    ["GNRMC,125000.20,A,5218.0,N,01330.6,W,10.0,30.0,200125,,,A", "GNZDA,125000.20,20,01,2025,00,00;GNVTG,30.0,T,,M,10.0,N,18.5,K,A"],
)
def test_speed_and_course_give_a_velocity(text: str):
    """From RMC, or from VTG behind a sentence of the same time; of the vertical it says nothing."""
    decoder = NmeaDecoder()
    for part in text.split(";"):
        decoder.decode(frame(part))
    velocity = fix_of(decoder, GGA.format(quality=1)).velocity_ned_mps
    speed_mps = 10.0 * 1852.0 / 3600.0
    assert velocity == (
        pytest.approx(speed_mps * cos(radians(30.0))),
        pytest.approx(speed_mps * sin(radians(30.0))),
        pytest.approx(nan, nan_ok=True),
    )
    assert fix_of(decoder, GGA.format(quality=1).replace("125000.20", "125001.20")).velocity_ned_mps is None


def views_of(*texts: str) -> list[SatellitesInView]:
    decoder = NmeaDecoder()
    found = [message for text in texts for message in decoder.decode(frame(text))]
    return [message for message in found if isinstance(message, SatellitesInView)]


CYCLE = (
    "GNGSA,A,3,05,10,,,,,,,,,,,1.0,0.6,0.8,1",
    "GNGSA,A,3,66,,,,,,,,,,,,1.0,0.6,0.8,2",
    "GPGSV,2,1,05,05,06,110,19,10,24,284,34,13,37,124,,40,30,200,35,1",
    "GPGSV,2,2,05,194,63,083,41,1",
    "GPGSV,1,1,01,10,24,284,39,6",
    "GLGSV,1,1,02,66,58,305,32,,12,137,20,1",
    "GAGSV,1,1,01,04,09,322,22,7",
    "GBGSV,1,1,01,19,45,100,44,1",
)


def test_satellites_in_view_are_those_of_a_cycle():
    """All talkers and signals together, each satellite once with its best C/N0; used are those of GSA."""
    (view,) = views_of(*CYCLE, *CYCLE)
    seen = {satellite_id(one.satellite): one for one in view.satellites}
    assert {name: one.cn0_dbhz for name, one in seen.items() if name != "G13"} == {
        "G05": 19, "G10": 39, "S27": 35, "J02": 41, "R02": 32, "E04": 22, "C19": 44,
    }  # fmt: skip
    assert (isnan(seen["G13"].cn0_dbhz), seen["G13"].quality) == (True, 1)
    assert (degrees_of(seen["G05"].elevation_rad), degrees_of(seen["G05"].azimuth_rad)) == pytest.approx((6.0, 110.0))
    assert {name for name, one in seen.items() if one.used} == {"G05", "G10", "R02"}


def test_used_satellites_of_a_cycle_replace_those_of_the_last_one():
    """More than twelve come in two sentences in a row."""
    first = ["GPGSA,A,3,01,02,,,,,,,,,,,1,1,1", "GPGSA,A,3,03,,,,,,,,,,,,1,1,1"]
    second = ["GPGSA,A,3,04,,,,,,,,,,,,1,1,1"]
    shown = "GPGSV,1,1,04,01,,,30,02,,,30,03,,,30,04,,,30"
    views = views_of(*first, shown, *second, shown, *second, shown)
    assert [[satellite_id(one.satellite) for one in view.satellites if one.used] for view in views] == [["G04"], ["G04"]]


@given(text=st.lists(st.text("0123456789,", max_size=60), max_size=12), talker=st.sampled_from(["GP", "GL", "GA", "GB", "GN", "XX", ""]))
@settings(max_examples=100, deadline=None)
def test_random_satellites_never_raise(text: list[str], talker: str):
    decoder = NmeaDecoder(GpsTime(2350, 0.0))
    for fields in text:
        for sentence in ("GSV,1,1,01", "GSV", "GSA,A,3", "GSA", "HDT", "THS", "VTG", "ZDA"):
            decoder.decode(frame(f"{talker}{sentence},{fields}"))
