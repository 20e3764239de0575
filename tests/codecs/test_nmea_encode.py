"""NMEA sentences: pynmeagps reads what was written, our decoder gets the position back, checksums hold."""

from datetime import UTC, datetime
from math import cos, degrees, isclose, nan, radians, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pynmeagps import NMEAMessage, NMEAReader

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Protocol
from rtkmesh.codecs.nmea import NmeaDecoder
from rtkmesh.codecs.nmea_encode import (
    Position,
    SatelliteInView,
    gga,
    gsa,
    gst,
    gsv,
    hdt,
    rmc,
    ths,
    vtg,
    zda,
)
from rtkmesh.gnss.ellipse import ErrorEllipse, error_ellipse
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.signals import satellite_number
from rtkmesh.gnss.time import GpsTime

UTC_TIME = datetime(2024, 2, 29, 23, 59, 58, 120_000, tzinfo=UTC)
PLACE = Position(52.123456789, -13.4, 80.5, 40.25)
positions = st.builds(Position, st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), st.floats(-400.0, 9000.0), st.floats(-100.0, 90.0))
times = st.datetimes(datetime(2000, 1, 1), datetime(2090, 1, 1)).map(lambda time: time.replace(tzinfo=UTC))


def read(sentence: str) -> NMEAMessage:
    assert sentence.endswith("\r\n")
    assert len(sentence) <= 100
    message = NMEAReader.parse(sentence.encode(), validate=1)
    assert isinstance(message, NMEAMessage)
    return message


@given(position=positions, time=times, quality=st.integers(1, 6), satellites=st.integers(0, 60), age_s=st.floats(0.0, 99.0))
def test_gga_reads_back(position: Position, time: datetime, quality: int, satellites: int, age_s: float):
    told = read(gga(time, position, quality, satellites, hdop=0.8, age_s=age_s, station_id=12))
    assert isclose(told.lat, position.lat_deg, abs_tol=2e-9)
    assert isclose(told.lon, position.lon_deg, abs_tol=2e-9)
    assert (told.quality, told.numSV, told.HDOP, int(told.diffStation)) == (quality, satellites, 0.8, 12)
    assert (told.alt + told.sep, told.sep) == pytest.approx((position.height_m, position.geoid_m), abs=1.1e-3)
    assert told.diffAge == pytest.approx(age_s, abs=0.051)


@given(position=positions, time=times)
def test_our_decoder_gets_the_place_and_the_instant_back(position: Position, time: datetime):
    """GST gives the sigmas, RMC the date, GGA the rest, rounded to hundredths of a second also over midnight."""
    text = gst(time, ErrorEllipse(0.03, 0.01, 45.0), 0.02, 0.02, 0.05) + rmc(time, position) + gga(time, position, 4, 20)
    decoder, framer = NmeaDecoder(), Framer([Protocol.NMEA])
    [fix] = [message for frame in framer.feed(text.encode()) for message in decoder.decode(frame)]
    assert isinstance(fix, ReceiverFix)
    assert not decoder.counters.rejected
    assert fix.time is not None
    assert abs(fix.time - GpsTime.from_utc(time)) < 0.0051
    assert (degrees(fix.lat_rad), degrees(fix.lon_rad)) == pytest.approx(position[:2], abs=2e-9)
    assert (fix.height_m, fix.vertical_sigma_m, fix.fix) == pytest.approx((position.height_m, 0.05, 6), abs=1.1e-3)


def test_rmc_vtg_zda_heading():
    told = read(rmc(UTC_TIME, PLACE, speed_mps=5.0, course_deg=-90.0, mode="R"))
    assert (told.status, told.spd, told.cog, told.date, told.posMode) == ("A", 9.719, 270.0, UTC_TIME.date(), "R")
    told = read(vtg(5.0, 359.99, mode="D"))
    assert (told.cogt, told.sogn, told.sogk, told.posMode) == (359.99, 9.719, 18.0, "D")
    told = read(zda(UTC_TIME))
    assert (told.time, told.day, told.month, told.year) == (UTC_TIME.time(), 29, 2, 2024)
    assert read(hdt(-0.125)).headingT == 359.875
    told = read(ths(12.3456))
    assert (told.headt, told.mi) == (12.346, "A")


def test_what_is_not_known_is_an_empty_field():
    assert gga(UTC_TIME, None, 4, 0) == "$GNGGA,235958.12,,,,,0,00,,,M,,M,,*55\r\n"
    assert read(rmc(UTC_TIME, None)).status == "V"
    assert "GNTHS,,V" in ths(nan)
    assert read(gst(UTC_TIME, ErrorEllipse(nan, nan, nan), 1.0, 2.0, 3.0)).stdLat == 1.0


def test_a_second_that_rounds_up_to_midnight_is_of_the_next_day():
    late = datetime(2024, 2, 29, 23, 59, 59, 996_000, tzinfo=UTC)
    told = read(rmc(late, PLACE))
    assert (told.time.isoformat(), told.date.isoformat()) == ("00:00:00", "2024-03-01")


def test_sixty_minutes_never_stand_there():
    assert ",5300.0000000,N," in gga(UTC_TIME, Position(52.9999999999999, 0.0), 1, 5)


@given(st.floats(0.001, 10.0), st.floats(0.0, 1.0), st.floats(0.0, 179.0))
def test_the_ellipse_is_that_of_the_covariance(major_m: float, share: float, direction_deg: float):
    minor_m, turn = major_m * share * 0.9, radians(direction_deg)
    axes = np.array([[cos(turn), -sin(turn)], [sin(turn), cos(turn)]])  # north, east
    covariance = axes @ np.diag([major_m**2, minor_m**2]) @ axes.T
    ellipse = error_ellipse(covariance[0, 0], covariance[1, 1], covariance[0, 1])
    assert (ellipse.major_m, ellipse.minor_m) == pytest.approx((major_m, minor_m), abs=1e-6 * major_m + 1e-4 * minor_m + 1e-7)
    assert abs((ellipse.direction_deg - direction_deg + 90.0) % 180.0 - 90.0) < 1e-3


def test_satellites_in_use_by_system():
    """Twelve in a sentence; SBAS, GLONASS and QZSS have numbers of their own in NMEA."""
    names = [f"G{k:02d}" for k in range(1, 15)] + ["S33", "R07", "E11", "C23", "J02"]
    sentences = [read(text) for text in gsa(map(satellite_number, names), 3, 1.5, 0.9, 1.2)]
    assert [int(told.systemId) for told in sentences] == [1, 1, 2, 3, 4, 5]
    assert [told.svid_01 for told in sentences] == [1, 13, 71, 11, 23, 194]
    assert sentences[1].svid_03 == 46
    assert {(told.navMode, told.PDOP, told.HDOP, told.VDOP) for told in sentences} == {(3, 1.5, 0.9, 1.2)}


def test_satellites_in_view_four_in_a_sentence():
    views = [SatelliteInView(satellite_number(f"E{k:02d}"), 10.0 * k, 300.0 + 20.0 * k, 30.0 + k) for k in range(1, 6)]
    views += [SatelliteInView(satellite_number("G05"), nan, nan, 44.4), SatelliteInView(satellite_number("R01"), 5.0, 10.0)]
    sentences = [read(text) for text in gsv(views)]
    assert [(told.talker, told.numMsg, told.msgNum, told.numSV) for told in sentences] == [
        ("GP", 1, 1, 1), ("GL", 1, 1, 1), ("GA", 2, 1, 5), ("GA", 2, 2, 5)
    ]  # fmt: skip
    last = sentences[3]
    assert (last.svid_01, last.elv_01, last.az_01, last.cno_01) == (5, 50, 40, 35)
    assert (sentences[0].elv_01, sentences[0].cno_01) == ("", 44)
    assert sentences[1].cno_01 == ""
