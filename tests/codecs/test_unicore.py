"""Unicore N4 logs: what real lines mean, both antennas, both forms, round trips, and damaged bodies."""

from dataclasses import replace
from math import degrees, isnan, nan, radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.codecs.drawn_epochs import TIME, check_epoch, epochs, every_signal

from rtkmesh.codecs.checksums import crc32
from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.framing_unicore import UNICORE_LOGS
from rtkmesh.codecs.messages import Message, Protocol
from rtkmesh.codecs.rtcm3_encode import encode_epoch
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.unicore import UnicoreDecoder
from rtkmesh.codecs.unicore_encode import (
    ascii_log,
    binary_log,
    encode_compressed,
    encode_compressed_ascii,
    encode_ephemeris,
    encode_ephemeris_ascii,
    encode_heading,
    encode_observations,
    encode_observations_ascii,
    encode_position,
)
from rtkmesh.codecs.unicore_ephemeris import READERS
from rtkmesh.codecs.unicore_signals import SIGNALS
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, NavigationMessage, ReceiverFix
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.receiver import CarrierSolution, CommandAnswer, ReceiverHeading, ReceiverVersion
from rtkmesh.gnss.signals import NO_CHANNEL, SATELLITES_PER_SYSTEM, carrier_hz, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.sky import SATELLITES as SIMULATED
from rtkmesh.simulation.sky import broadcast

ALL = every_signal(SIGNALS)


def decoded(data: bytes, decoder: UnicoreDecoder | None = None) -> list[Message]:
    decoder = decoder or UnicoreDecoder()
    frames = Framer([Protocol.UNICORE]).feed(data)
    assert sum(len(frame.data) for frame in frames) == len(data), "every byte belongs to a frame"
    return [message for frame in frames for message in decoder.decode(frame)]


def only(data: bytes, decoder: UnicoreDecoder | None = None) -> Any:
    (message,) = decoded(data, decoder)
    return message


LINES = (
    ("1,0,1,17661005.670,-92809209.627852,6,50,2037.974,5000,0,16.010,20181c23", ("G01", "1C", NO_CHANNEL)),
    ("1,0,16,20814337.133,-85231236.201565,227,534,2063.807,3272,0,6.760,21301c22", ("G16", "2W", NO_CHANNEL)),
    ("1,7,52,18851471.802,-100736546.989518,18,52,626.918,4760,0,9.200,00191c43", ("R15", "1C", 0)),
    ("1,0,26,21720097.812,-114139892.254585,52,181,-2263.222,4270,0,6262.010,00181c23", ("G26", "1C", NO_CHANNEL)),
)


@pytest.mark.parametrize(("body", "identity"), LINES)
def test_lines_of_real_receivers(body: str, identity: tuple[str, str, int]):
    """Measurements of a UM980 and of the manual: the phase has the receiver's sign turned, and lies near the pseudorange."""
    epoch = only(ascii_log("OBSVM", TIME, body))
    words = body.split(",")
    ((satellite, code, pseudorange_m, phase_cyc, doppler_hz, cn0_dbhz),) = epoch.rows()
    assert (satellite, code, int(epoch.channel[0])) == identity
    assert (pseudorange_m, phase_cyc) == (float(words[3]), -float(words[4]))
    assert (doppler_hz, cn0_dbhz) == pytest.approx((float(words[7]), float(words[8]) / 100))
    assert epoch.lock_s[0] == pytest.approx(float(words[10]))
    assert epoch.pseudorange_sigma_m[0] == pytest.approx(float(words[5]) / 100)
    assert epoch.phase_sigma_cyc[0] == pytest.approx(float(words[6]) / 1e4)
    wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz(int(epoch.satellite[0]), int(epoch.signal[0]), int(epoch.channel[0]))
    assert phase_cyc * wavelength_m == pytest.approx(pseudorange_m, abs=50.0)
    assert epoch.time == TIME


def test_a_compressed_line_of_a_real_receiver_gets_its_rolls_back():
    """Figures of a UM980's OBSVMCMP: 22 580 544.094 m, -1 219 049.086 cycles, seven rolls of 2^24 cycles."""
    sent = make_epoch(
        TIME, satellite=[satellite_number("G18")], signal=[signal_number("1C")], pseudorange_m=[22580544.09375],
        phase_cyc=[1219049.0859375], doppler_hz=[3555.9375], cn0_dbhz=[43.0], lock_s=[13.625], phase_sigma_cyc=[0.004],
    )  # fmt: skip
    epoch = only(encode_compressed(sent))
    assert epoch.phase_cyc[0] == 1219049.0859375 + 7 * 2**24
    assert (epoch.pseudorange_m[0], epoch.doppler_hz[0], epoch.cn0_dbhz[0], epoch.lock_s[0]) == (22580544.09375, 3555.9375, 43.0, 13.625)


@given(sent=epochs(ALL))
@settings(max_examples=60, deadline=None)
def test_observations_come_back_as_they_were_sent(sent: Epoch):
    """Binary exactly, ASCII to its digits, with sigmas, lock time and C/N0."""
    binary, text = only(encode_observations(sent)), only(encode_observations_ascii(sent))
    check_epoch(binary, sent, {"pseudorange_m": 0.0, "phase_cyc": 0.0, "doppler_hz": 5e-4})
    check_epoch(text, sent, {"pseudorange_m": 5.1e-4, "phase_cyc": 5.1e-7, "doppler_hz": 1.6e-3})  # the Doppler is rounded three times
    for found in (binary, text):
        np.testing.assert_allclose(found.cn0_dbhz, sent.cn0_dbhz, atol=0.0051)
        np.testing.assert_allclose(found.lock_s, sent.lock_s, atol=0.003)
        np.testing.assert_allclose(found.pseudorange_sigma_m, sent.pseudorange_sigma_m, atol=0.0051)
        np.testing.assert_allclose(found.phase_sigma_cyc, sent.phase_sigma_cyc, atol=5.1e-5)


@given(sent=epochs(ALL))
@settings(max_examples=60, deadline=None)
def test_compressed_observations_come_back(sent: Epoch):
    """Negative Dopplers, rolled phases and the table of sigmas, in both forms."""
    kept = sent.take(np.isfinite(sent.pseudorange_m))  # without a pseudorange nobody knows the rolls
    if not len(kept):
        return
    binary, text = only(encode_compressed(kept)), only(encode_compressed_ascii(kept))
    check_epoch(binary, kept, {"pseudorange_m": 1 / 256 + 1e-9, "phase_cyc": 1 / 512 + 1e-7, "doppler_hz": 1 / 512 + 1e-3})
    np.testing.assert_array_equal(binary.phase_cyc, text.phase_cyc)
    np.testing.assert_allclose(binary.lock_s, kept.lock_s, atol=1 / 32)
    ratio = binary.pseudorange_sigma_m / kept.pseudorange_sigma_m
    assert ((ratio > 0.9) & (ratio < 2.0)).all()


def one(antenna: int, **columns: Any) -> bytes:
    epoch = make_epoch(TIME, satellite=[5], signal=[28], pseudorange_m=[2.2e7], phase_cyc=[1.15e8], lock_s=[9.0], **columns)
    return encode_observations(epoch, "OBSVM" if antenna == 1 else "OBSVH")


def test_each_antenna_has_its_observations():
    """The main antenna's decoder does not take the second one's, nor the other way round."""
    both = one(1) + one(2)
    for antenna, other in ((1, "OBSVHB"), (2, "OBSVMB")):
        decoder = UnicoreDecoder(antenna)
        assert len(decoded(both, decoder)) == 1
        assert decoder.counters.ignored == {f"unicore/{other}": 1}


def test_rtcm_of_the_main_antenna_is_not_the_second_one():
    """A receiver may send its main antenna's observations as RTCM as well."""
    epoch = make_epoch(TIME, satellite=[5], signal=[28], pseudorange_m=[2.2e7], phase_cyc=[1.15e8], lock_s=[9.0])
    data = b"".join(encode_epoch(epoch, 1)) + encode_observations(epoch)
    decoder = StreamDecoder(StreamOptions(approximate_time=TIME, antenna=2))
    found = [message for _, some in decoder.feed(data * 40) for message in some] + decoder.flush()
    assert not [message for message in found if isinstance(message, Epoch)]


def at(seconds: float, lock_s: float, phase_cyc: float = 1.15e8) -> bytes:
    time = TIME + seconds
    return encode_observations(
        make_epoch(time, satellite=[5], signal=[28], pseudorange_m=[2.2e7], phase_cyc=[phase_cyc], cn0_dbhz=[45.0], lock_s=[lock_s])
    )


def test_a_lock_time_that_fell_is_a_slip():
    """So is one that is too short for the time that has gone by; a slip without a phase waits for the next phase."""
    data = [at(0, 50.0), at(1, 51.0), at(2, 0.5), at(3, 1.5), at(10, 2.0), at(11, 0.2, nan), at(12, 1.2), at(13, 2.2)]
    decoder = UnicoreDecoder()
    flags = [bool(only(part, decoder).flags[0] & SLIP) for part in data]
    assert flags == [False, False, True, False, True, False, True, False]


def test_phases_without_lock_are_none():
    """A phase whose half cycle is open is sent as not locked; then there is no Doppler either, but a pseudorange."""
    epoch = only(one(1, flags=[HALF_CYCLE], doppler_hz=[100.0]))
    assert isnan(epoch.phase_cyc[0])
    assert isnan(epoch.doppler_hz[0])
    assert epoch.pseudorange_m[0] == 2.2e7


def test_unknown_signals_and_times_are_counted():
    """Signal types that the table does not have, and logs before the receiver knows the time."""
    decoder = UnicoreDecoder()
    body = "2,0,1,17661005.670,-92809209.6,6,50,2037.9,5000,0,16.010,20181c23,0,1,17661005.6,-92809209.6,6,50,2037.9,5000,0,16.0,03e01c23"
    assert len(only(ascii_log("OBSVM", TIME, body), decoder)) == 1
    assert decoder.counters.rejected == {"unicore/OBSVM unknown signal": 1}
    assert decoded(binary_log("OBSVM", GpsTime(0, 5.0), bytes(4)), decoder) == []
    assert decoder.counters.rejected["unicore/OBSVMB time"] == 1
    assert decoded(ascii_log("OBSVH", TIME, "0"), UnicoreDecoder(2)) != []


def test_headings_of_real_receivers(sentences: dict[str, list[Message]]):
    """Fixed, float and single-frequency float solutions of UM982 boards, in radians, with the receiver's own sigmas."""
    headings = [message for message in sentences["UNIHEADINGA"] if isinstance(message, ReceiverHeading)]
    told = [(h.solution, round(degrees(h.heading_rad), 4), round(degrees(h.pitch_rad), 4), round(h.length_m, 4)) for h in headings]
    assert told == [
        (CarrierSolution.FIXED, 41.3574, -0.9784, 1.3868),
        (CarrierSolution.FLOAT, 260.1887, -35.0258, 12.2446),
        (CarrierSolution.FLOAT, 219.9783, 24.6813, 5.5208),
        (CarrierSolution.FIXED, 179.0284, -2.4202, 1.4773),
        (CarrierSolution.FIXED, 90.0, 10.0, 1.0),
    ]
    assert degrees(headings[0].heading_sigma_rad) == pytest.approx(0.1966)
    assert degrees(headings[0].pitch_sigma_rad) == pytest.approx(0.5238)
    assert (headings[0].satellites, headings[0].station) == (35, "999")
    assert headings[0].time == GpsTime(2433, 239990.4)


def test_a_position_of_a_real_receiver(sentences: dict[str, list[Message]]):
    """The ellipsoidal height is height and undulation; the track is in degrees."""
    (fix,) = sentences["BESTNAVA"]
    assert isinstance(fix, ReceiverFix)
    assert (fix.fix, fix.satellites, fix.time) == (6, 36, GpsTime(2433, 239990.4))
    assert (degrees(fix.lat_rad), degrees(fix.lon_rad)) == pytest.approx((-7.89377025183, -78.13098235479), abs=1e-11)
    assert fix.height_m == pytest.approx(3363.0132 + 22.3499)
    assert (fix.horizontal_sigma_m, fix.vertical_sigma_m) == pytest.approx((0.022943, 0.0694), abs=1e-5)
    north, east, down = fix.velocity_ned_mps or (nan, nan, nan)
    assert (north, east, down) == pytest.approx((0.0006 * np.cos(radians(251.626423)), 0.0006 * np.sin(radians(251.626423)), 0.0012))


@pytest.fixture(scope="module")
def sentences(data: Path) -> dict[str, list[Message]]:
    """What the recorded lines mean, by the kind of log."""
    decoder, found = UnicoreDecoder(), dict[str, list[Message]]()
    for frame in Framer([Protocol.UNICORE]).feed((data / "dec_unicore" / "um982_sentences.txt").read_bytes()):
        found.setdefault(frame.kind, []).extend(decoder.decode(frame))
    return found


NO_SOLUTION = (
    b'#UNIHEADINGA,97,GPS,FINE,2190,365174000,0,0,18,12;INSUFFICIENT_OBS,NONE,0.0000,0.0000,0.0000,0.0000,0.0000,0.0000,"",0,0,0,0,0,00,0,0'
    b"*ee072604\r\n"
)


def test_no_solution_is_no_north():
    """The manual's example: zeros that mean nothing."""
    heading = only(NO_SOLUTION)
    assert not heading.valid
    assert heading.solution is CarrierSolution.NONE
    assert isnan(heading.heading_rad)
    assert isnan(heading.pitch_rad)
    assert isnan(heading.length_m)


@given(
    fix=st.sampled_from([2, 4, 5, 6]), lat=st.floats(-89.0, 89.0), lon=st.floats(-179.0, 179.0), height=st.floats(-100.0, 9000.0),
    speed=st.tuples(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), st.floats(-5.0, 5.0)),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_positions_come_back(fix: int, lat: float, lon: float, height: float, speed: tuple[float, float, float]):
    """Of either antenna."""
    sent = ReceiverFix(TIME, fix, radians(lat), radians(lon), height, 0.5, 0.75, speed, 21)
    for name, antenna in (("BESTNAV", 1), ("BESTNAVH", 2)):
        found = only(encode_position(sent, name), UnicoreDecoder(antenna))
        assert found.fix == (3 if fix == 2 else fix)
        assert (found.lat_rad, found.lon_rad, found.height_m) == pytest.approx((sent.lat_rad, sent.lon_rad, height), abs=1e-9)
        assert found.velocity_ned_mps == pytest.approx(speed, abs=1e-9)
        assert (found.horizontal_sigma_m, found.vertical_sigma_m, found.satellites) == (pytest.approx(0.5), 0.75, 21)


def test_headings_come_back():
    """Also those that are none."""
    sent = ReceiverHeading(
        TIME, "UNIHEADING", CarrierSolution.FIXED, heading_rad=2.5, heading_sigma_rad=0.01, pitch_rad=-0.125, pitch_sigma_rad=0.02,
        length_m=1.25, satellites=20, station="999",
    )  # fmt: skip
    found = only(encode_heading(sent))
    for name in ("heading_rad", "heading_sigma_rad", "pitch_rad", "pitch_sigma_rad", "length_m"):
        assert getattr(found, name) == pytest.approx(getattr(sent, name), rel=1e-6)
    assert (found.solution, found.satellites, found.station, found.time) == (CarrierSolution.FIXED, 20, "999", TIME)
    assert not only(encode_heading(replace(sent, heading_rad=nan))).valid


def simulated_ephemerides() -> list[Ephemeris]:
    """Return one ephemeris of each system, Galileo in both messages, QZSS and a geostationary BeiDou satellite made of others."""
    found = {int(s) // SATELLITES_PER_SYSTEM: broadcast(int(s), TIME) for s in SIMULATED}
    gps, galileo, beidou = found[0], found[2], found[3]
    assert isinstance(gps, KeplerEphemeris)
    assert isinstance(galileo, KeplerEphemeris)
    assert isinstance(beidou, KeplerEphemeris)
    fnav = replace(galileo, message=NavigationMessage.FNAV, group_delay_s=(galileo.group_delay_s[0], 0.0), health=0)
    qzss = replace(gps, satellite=satellite_number("J03"), fit_s=7200.0)
    return [*found.values(), fnav, qzss, replace(beidou, satellite=satellite_number("C03"), message=NavigationMessage.D2)]


@pytest.mark.parametrize("sent", simulated_ephemerides(), ids=lambda e: f"{e.satellite}-{getattr(e, 'message', 'FDMA')}")
def test_ephemerides_come_back(sent: Ephemeris):
    """All values of all systems, binary and ASCII; the time of transmission is that of the log."""
    at_s = TIME + 20.0
    for data in (encode_ephemeris(sent, at_s), encode_ephemeris_ascii(sent, at_s)):
        found = only(data)
        if isinstance(sent, KeplerEphemeris):
            assert found.accuracy_m == pytest.approx(sent.accuracy_m)
            assert found.sqrt_a == pytest.approx(sent.sqrt_a, rel=1e-14)
            expected = replace(sent, transmitted=at_s, accuracy_m=found.accuracy_m, sqrt_a=found.sqrt_a)
            assert found == expected
        else:
            assert isinstance(sent, GlonassEphemeris)
            assert found == replace(sent, transmitted=found.transmitted, age_days=0)
            assert abs(found.transmitted - sent.transmitted) < 1.0


def test_ephemerides_of_no_satellite_are_rejected():
    """Numbers out of range, no orbit, not finite, no time, too short."""
    sent = broadcast(satellite_number("G05"), TIME)
    assert isinstance(sent, KeplerEphemeris)
    bad = [
        replace(sent, satellite=satellite_number("G05") + 40), replace(sent, sqrt_a=10.0), replace(sent, eccentricity=nan),
        replace(sent, accuracy_m=nan),
    ]  # fmt: skip
    decoder = UnicoreDecoder()
    for ephemeris in bad:
        assert decoded(encode_ephemeris(ephemeris, TIME), decoder) == []
    assert decoded(encode_ephemeris(sent, GpsTime(0, 0.0)), decoder) == []
    assert decoded(binary_log("GPSEPH", TIME, bytes(100)), decoder) == []
    assert decoder.counters.rejected == {
        "unicore/GPSEPHB orbit": 2, "unicore/GPSEPHB value": 2, "unicore/GPSEPHB time": 1, "unicore/GPSEPHB length": 1,
    }  # fmt: skip


def test_the_version_tells_model_and_firmware():
    """The line of a UM982."""
    line = (
        b'#VERSIONA,79,GPS,FINE,2326,378237000,15434,0,18,889;"UM982","R4.10Build15434","HRPT00-S10C-P","2310415000012-LR23A2225208904",'
        b'"ff2740966a10124c","2024/08/08"*769fd54f\r\n'
    )
    version = only(line)
    assert isinstance(version, ReceiverVersion)
    assert (version.model, version.software) == ("UM982", "R4.10Build15434")
    body = (17).to_bytes(4, "little") + b"R4.10Build7923".ljust(33, b"\0") + bytes(129 + 66 + 33 + 43)
    assert only(binary_log("VERSION", TIME, body)).model == "UM982"


def test_answers_to_commands_are_told():
    """They come as sentences; a refusal says why."""
    decoder = StreamDecoder()
    lines = b""
    for text in (b"command,CONFIG HEADING LENGTH 100 5,response: OK", b"command,MODE NORTH,response: PARSING FAILED, NO FUNC"):
        check = 0
        for byte in text:
            check ^= byte
        lines += b"$%s*%02x\r\n" % (text, check)
    answers = [message for _, some in decoder.feed(lines) for message in some]
    assert answers == [
        CommandAnswer("CONFIG HEADING LENGTH 100 5", accepted=True, text="OK"),
        CommandAnswer("MODE NORTH", accepted=False, text="PARSING FAILED, NO FUNC"),
    ]


NAMES = sorted({*UNICORE_LOGS.values()})


@given(name=st.sampled_from(NAMES), body=st.binary(max_size=300), antenna=st.sampled_from([1, 2]), counted=st.booleans())
@settings(max_examples=400, deadline=None)
def test_any_binary_body_is_a_value_or_a_reason(name: str, body: bytes, antenna: int, *, counted: bool):
    """Bodies of any length and content behind a right checksum never raise, counts of rows included."""
    if counted and len(body) > 4:
        body = (len(body) // 24).to_bytes(4, "little") + body
    decoder = UnicoreDecoder(antenna)
    messages = decoded(binary_log(name, TIME, body), decoder)
    total = decoder.counters.decoded.total() + decoder.counters.ignored.total()
    rejected = sum(count for reason, count in decoder.counters.rejected.items() if "signal" not in reason)
    assert total + rejected == 1
    assert len(messages) <= 2


WORDS = st.one_of(
    st.sampled_from(["SOL_COMPUTED", "NARROW_INT", "NONE", "", '"999"', "nan", "-inf", "1e400", "TRUE", "f3", "20181c23", "-1", "1_0"]),
    st.integers(-5, 2**40).map(str),
    st.floats().map(str),
    st.text("0123456789abcdef", max_size=48),
)  # fmt: skip


@given(name=st.sampled_from(NAMES), words=st.lists(WORDS, max_size=60), antenna=st.sampled_from([1, 2]))
@settings(max_examples=400, deadline=None)
def test_any_text_body_is_a_value_or_a_reason(name: str, words: list[str], antenna: int):
    """Words of any kind where numbers should be."""
    decoder = UnicoreDecoder(antenna)
    decoded(ascii_log(name, TIME, ",".join(words)), decoder)
    assert decoder.counters.decoded.total() + decoder.counters.ignored.total() + decoder.counters.rejected.total() >= 1


@given(values=st.lists(st.floats(width=32), min_size=60, max_size=60), name=st.sampled_from(sorted([*READERS, "BESTNAV", "UNIHEADING"])))
@settings(max_examples=150, deadline=None)
def test_any_numbers_make_a_value_or_a_reason(values: list[float], name: str):
    """Numbers of any size in logs of the right length."""
    decoded(binary_log(name, TIME, np.array(values, "<f8").tobytes()))


@pytest.mark.parametrize("header", ["OBSVMA", "OBSVMA,1,GPS,3", "OBSVMA,1,GPS,FINE,x,y,0,0,18,1", "OBSVMA,1,GPS,FINE,999999999,1,0,0,18,1"])
def test_headers_that_are_none_are_no_log(header: str):
    """Replies and damaged headers."""
    text = f"{header},;0" if "," not in header else f"{header};0"
    data = f"#{text}*{crc32(text.encode()):08x}\r\n".encode()
    assert decoded(data) == []
