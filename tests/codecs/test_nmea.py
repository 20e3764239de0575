"""NMEA sentences to the receiver's own fix."""

from math import radians

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.nmea import NmeaDecoder
from rtkmesh.gnss.ephemeris import ReceiverFix
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
    assert decoder.decode(frame("GPGSV,1,1,0")) == []
    assert decoder.counters.ignored == {"nmea/GPGSV": 1}
