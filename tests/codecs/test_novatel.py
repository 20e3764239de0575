"""NovAtel OEM4 to OEM7 logs: published lines, both antennas, both forms, round trips, half cycles, and damaged bodies."""

from dataclasses import replace
from math import degrees, isnan, radians
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.codecs.drawn_epochs import TIME, check_epoch, epochs, every_signal

from rtkmesh.codecs import novatel_encode as encode
from rtkmesh.codecs.checksums import crc32
from rtkmesh.codecs.ephemerides import lnav_ephemeris
from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.framing_novatel import NOVATEL_LOGS, NOVATEL_MAX_PAYLOAD
from rtkmesh.codecs.messages import Message, Protocol
from rtkmesh.codecs.novatel import NovatelDecoder
from rtkmesh.codecs.novatel_signals import SIGNALS
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.subframes_encode import lnav_subframes
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import Ephemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage, ReceiverFix
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading, ReceiverVersion
from rtkmesh.gnss.signals import GALILEO, GPS, NO_CHANNEL, SATELLITES_PER_SYSTEM, carrier_hz
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.sky import KLOBUCHAR, broadcast
from rtkmesh.simulation.sky import SATELLITES as SIMULATED

ALL = every_signal(SIGNALS)


def decoded(data: bytes, decoder: NovatelDecoder | None = None) -> list[Message]:
    decoder = decoder or NovatelDecoder()
    frames = Framer([Protocol.NOVATEL]).feed(data)
    assert sum(len(frame.data) for frame in frames) == len(data), "every byte belongs to a frame"
    return [message for frame in frames for message in decoder.decode(frame)]


def only(data: bytes, decoder: NovatelDecoder | None = None) -> Any:
    (message,) = decoded(data, decoder)
    return message


# Lines of receivers, as the maker's manual and public parsers quote them.
BESTPOS = (
    b"#BESTPOSA,COM1,0,90.5,FINESTEERING,1949,403742.000,02000000,b1f6,32768;SOL_COMPUTED,SINGLE,51.15043699323,-114.03067932462,1064.9520,"
    b'-17.0000,WGS84,1.1782,1.2205,2.6283,"",0.000,0.000,17,17,17,17,00,06,39,33*'
)
RANGE = (
    b"#RANGEA,USB1,0,54.0,FINESTEERING,2209,512449.000,02000020,5103,16809;2,26,0,24101771.233,0.199,-126655684.482618,0.012,2806.247,44.4,"
    b"853.017,1810dc04,26,0,24101778.285,0.063,-98692757.083922,0.012,2186.688,44.3,852.637,11305c0b*"
)
VERSION = (
    b'#VERSIONA,COM1,0,50.0,FINESTEERING,2209,515163.000,02000020,3681,16809;1,GPSCARD,"FFNRNNCBN","BMGX15360110W","OEM719-1.02",'
    b'"OM7MR0810RN0000","OM7BR0000RBG000","2020/Apr/27","20:12:35"*'
)


def sealed(line: bytes) -> bytes:
    return line + b"%08x\r\n" % crc32(line[1:-1])


def test_a_published_range_log():
    """The phase is minus the accumulated Doppler range; status 1810dc04 is GPS L1 C/A of satellite 26, locked, parity known."""
    epoch = only(sealed(RANGE))
    assert [(s, c) for s, c, *_ in epoch.rows()] == [("G26", "1C"), ("G26", "2W")]
    assert epoch.time == GpsTime(2209, 512449.0)
    assert sorted(epoch.phase_cyc.tolist()) == [98692757.083922, 126655684.482618]
    for k in range(2):
        wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz(int(epoch.satellite[k]), int(epoch.signal[k]), NO_CHANNEL)
        assert epoch.phase_cyc[k] * wavelength_m == pytest.approx(epoch.pseudorange_m[k], abs=50.0)
    assert epoch.cn0_dbhz.tolist() == pytest.approx([44.4, 44.3])
    assert epoch.lock_s.tolist() == pytest.approx([853.017, 852.637])
    assert epoch.pseudorange_sigma_m.tolist() == pytest.approx([0.199, 0.063])
    assert not epoch.flags.any()


def test_a_published_position_and_version():
    """The ellipsoidal height is height and undulation; a second satellites' field is that of those used."""
    fix = only(sealed(BESTPOS))
    assert isinstance(fix, ReceiverFix)
    assert (fix.fix, fix.satellites, fix.time) == (3, 17, GpsTime(1949, 403742.0))
    assert (degrees(fix.lat_rad), degrees(fix.lon_rad)) == pytest.approx((51.15043699323, -114.03067932462), abs=1e-11)
    assert (fix.height_m, fix.vertical_sigma_m) == pytest.approx((1047.952, 2.6283))
    version = only(sealed(VERSION))
    assert version == ReceiverVersion("OEM719-1.02", "OM7MR0810RN0000", "", ("FFNRNNCBN", "OM7BR0000RBG000"))


@given(sent=epochs(ALL, half_cycles=True))
@settings(max_examples=50, deadline=None)
def test_observations_come_back_as_they_were_sent(sent: Epoch):
    """Binary exactly (as far as single precision goes), ASCII to its digits; half cycles that are open stay open."""
    single = {"doppler_hz": 5e-4, "cn0_dbhz": 2e-6, "lock_s": 2e-3, "pseudorange_sigma_m": 5e-7, "phase_sigma_cyc": 2e-9}
    check_epoch(only(encode.encode_observations(sent)), sent, {"pseudorange_m": 0.0, "phase_cyc": 0.0, **single})
    text = {"doppler_hz": 1.6e-3, "cn0_dbhz": 0.051, "lock_s": 5e-3, "pseudorange_sigma_m": 5.1e-4, "phase_sigma_cyc": 5.1e-4}
    check_epoch(only(encode.encode_observations_ascii(sent)), sent, {"pseudorange_m": 5.1e-4, "phase_cyc": 5.1e-7, **text})


@given(sent=epochs(ALL, half_cycles=True))
@settings(max_examples=50, deadline=None)
def test_compressed_observations_come_back(sent: Epoch):
    """Negative Dopplers, rolled phases and the table of sigmas, in both forms."""
    kept = sent.take(np.isfinite(sent.pseudorange_m))  # without a pseudorange nobody knows the rolls
    if not len(kept):
        return
    binary, text = only(encode.encode_compressed(kept)), only(encode.encode_compressed_ascii(kept))
    steps = {
        "pseudorange_m": 1 / 256 + 1e-9,
        "phase_cyc": 1 / 512 + 1e-7,
        "doppler_hz": 1 / 512 + 1e-3,
        "cn0_dbhz": 0.501,
        "lock_s": 1 / 32,
    }
    check_epoch(binary, kept, steps)
    np.testing.assert_array_equal(binary.phase_cyc, text.phase_cyc)
    ratio = binary.pseudorange_sigma_m / kept.pseudorange_sigma_m
    assert ((ratio > 0.9) & (ratio < 2.0)).all()


def one(seconds: float = 0.0, source: int = 0, **columns: Any) -> bytes:
    values = {"pseudorange_m": [2.2e7], "phase_cyc": [1.15e8], "lock_s": [9.0 + seconds], **columns}
    return encode.encode_observations(make_epoch(TIME + seconds, satellite=[5], signal=[28], **values), source)


def test_each_antenna_has_its_observations():
    """Measurement source 1 is the second antenna, in ASCII ``RANGEA_1``; the whole stream's decoder keeps them apart too."""
    both = one() + one(source=1)
    for antenna in (1, 2):
        decoder = NovatelDecoder(antenna)
        assert len(decoded(both, decoder)) == 1
        assert decoder.counters.ignored == {"novatel/RANGEB": 1}
        stream = StreamDecoder(StreamOptions(antenna=antenna))
        assert [type(message) for _, found in stream.feed(both) for message in found] == [Epoch]
    line = b"#RANGEA_1" + RANGE[len("#RANGEA") :]
    assert len(only(sealed(line), NovatelDecoder(2))) == 2
    assert decoded(sealed(line)) == []


def test_a_lock_time_that_fell_is_a_slip_and_so_is_a_half_cycle_that_is_added():
    """Bit 28 of the tracking status says that half a cycle was added once the parity was known: the phase jumped."""
    decoder, flags = NovatelDecoder(), []
    for seconds, lock_s in ((0, 50.0), (1, 51.0), (2, 0.5), (3, 1.5), (10, 2.0)):
        flags.append(bool(only(one(seconds, lock_s=[lock_s]), decoder).flags[0] & SLIP))
    assert flags == [False, False, True, False, True]
    added = bytearray(one(11, lock_s=[3.0])[:-4])
    added[28 + 4 + 43] |= 0x10
    epoch = only(bytes(added) + crc32(bytes(added)).to_bytes(4, "little"), decoder)
    assert epoch.flags[0] & SLIP
    assert not epoch.flags[0] & HALF_CYCLE


def test_unknown_signals_and_times_are_counted():
    """Signal types that the table does not have, logs before the receiver knows the time, answers to commands."""
    decoder = NovatelDecoder()
    assert len(only(sealed(RANGE.replace(b"1810dc04", b"1bf0dc04")), decoder)) == 1
    assert decoder.counters.rejected == {"novatel/RANGE unknown signal": 1}
    early = encode.binary_log("RANGE", GpsTime(0, 5.0), bytes(4))
    assert decoded(early, decoder) == []
    assert decoder.counters.rejected["novatel/RANGEB time"] == 1
    answer = bytearray(encode.binary_log("RANGE", TIME, b"\x01\x00\x00\x00OK")[:-4])
    answer[6] |= 0x80
    assert decoded(bytes(answer) + crc32(bytes(answer)).to_bytes(4, "little"), decoder) == []
    assert decoder.counters.ignored == {"novatel/RANGEB": 1}


def short(number: int, body: bytes) -> bytes:
    log = b"\xaa\x44\x13" + bytes([len(body)]) + number.to_bytes(2, "little") + TIME.week.to_bytes(2, "little") + bytes(4) + body
    return log + crc32(log).to_bytes(4, "little")


def test_short_headers_and_unknown_logs_are_framed():
    """INSPVAS has a short header; what is not used is counted by name or number, beside Unicore's logs, which begin alike."""
    framer = Framer()
    data = short(508, bytes(88)) + one() + short(1462, b"") + b"\xaa\x44" + one(1)
    frames = [*framer.feed(data), *framer.flush()]
    assert [frame.kind for frame in frames] == ["INSPVASB", "RANGEB", "1462", "RANGEB"]
    assert framer.counters.bytes_skipped == 2
    decoder = NovatelDecoder()
    assert sum(len(decoder.decode(frame)) for frame in frames) == 2
    assert decoder.counters.ignored == {"novatel/INSPVASB": 1, "novatel/1462": 1}


@pytest.mark.parametrize("head", [b"\xaa\x44\x12\x1b", b"\xaa\x44\x12\x1c\x2b\x00\x00\x20\x01\x60", b"\xaa\x44\x11\x00", b"\xaa\x45"])
def test_what_is_no_log_costs_its_bytes_only(head: bytes):
    """Headers that are too short, payloads beyond the longest, OEM3's form, another second byte."""
    assert NOVATEL_MAX_PAYLOAD < 0x6001
    framer = Framer([Protocol.NOVATEL])
    assert [frame.data for frame in framer.feed(head + bytes(6) + one())] == [one()]
    assert framer.counters.bytes_skipped == len(head) + 6


def test_a_longer_header_is_skipped():
    """The manual says that the header may grow: its length is in it."""
    log = one()[:-4]
    grown = log[:3] + b"\x20" + log[4:28] + b"\xff" * 4 + log[28:]
    assert only(grown + crc32(grown).to_bytes(4, "little")).pseudorange_m.tolist() == [2.2e7]


def in_subframes(sent: KeplerEphemeris) -> KeplerEphemeris:
    """Return an LNAV ephemeris as the resolution of its subframes leaves it."""
    found = lnav_ephemeris(sent.satellite, lnav_subframes(sent, sent.transmitted), TIME)
    assert found is not None
    return found


def same_orbit(found: Ephemeris, sent: Ephemeris) -> bool:
    """Return whether an ephemeris came back, but for what its log does not say or rounds (raw subframes, variances)."""
    if not isinstance(found, KeplerEphemeris) or not isinstance(sent, KeplerEphemeris):
        return replace(found, transmitted=sent.transmitted) == sent
    assert (found.sqrt_a, found.accuracy_m) == pytest.approx((sent.sqrt_a, sent.accuracy_m), rel=1e-14)
    same = replace(found, transmitted=sent.transmitted, sqrt_a=sent.sqrt_a, accuracy_m=sent.accuracy_m, fit_s=sent.fit_s)
    return same == sent


def test_ephemerides_come_back():
    """Decoded and raw, of all systems; each in the log of its own name."""
    names, systems = set(), set()
    for satellite in SIMULATED.tolist():
        sent = broadcast(satellite, TIME)
        logs = [(encode.encode_ephemeris(sent, TIME), sent)]
        system = satellite // SATELLITES_PER_SYSTEM
        if isinstance(sent, KeplerEphemeris) and system == GPS:
            logs.append((encode.encode_raw_ephemeris(sent, TIME), in_subframes(sent)))
        if isinstance(sent, KeplerEphemeris) and system == GALILEO:
            logs.append((encode.encode_galileo(sent, TIME), sent))
            fnav = replace(sent, message=NavigationMessage.FNAV, group_delay_s=(sent.group_delay_s[0], 0.0), health=0)
            assert same_orbit(only(encode.encode_galileo(fnav, TIME)), fnav)
        for log, expected in logs:
            assert same_orbit(only(log), expected)
            names.add(NOVATEL_LOGS[int.from_bytes(log[4:6], "little")])
        systems.add(system)
    assert systems == {0, 1, 2, 3}
    assert names == {"GPSEPHEM", "RAWEPHEM", "GLOEPHEMERIS", "GALEPHEMERIS", "GALINAVEPHEMERIS", "BDSEPHEMERIS"}


def test_ephemerides_of_qzss_come_back():
    """As GPS, with their own numbers, decoded and raw."""
    gps = next(broadcast(s, TIME) for s in SIMULATED.tolist() if s // SATELLITES_PER_SYSTEM == GPS)
    assert isinstance(gps, KeplerEphemeris)
    sent = replace(gps, satellite=4 * SATELLITES_PER_SYSTEM + 2)
    assert same_orbit(only(encode.encode_ephemeris(sent, TIME)), sent)
    assert same_orbit(only(encode.encode_raw_ephemeris(sent, TIME)), in_subframes(sent))


def test_a_raw_ephemeris_in_hexadecimal():
    """RAWEPHEMA is the same three subframes as text; damaged ones are refused with the reason."""
    sent = next(e for e in (broadcast(s, TIME) for s in SIMULATED.tolist()) if isinstance(e, KeplerEphemeris) and e.satellite < 33)
    log = encode.encode_raw_ephemeris(sent, TIME)
    parts = [log[28 + 12 + 30 * i : 28 + 42 + 30 * i].hex() for i in range(3)]
    assert same_orbit(
        only(encode.ascii_log("RAWEPHEMA", TIME, ",".join([str(sent.satellite), "2419", "136800", *parts]))), in_subframes(sent)
    )
    decoder = NovatelDecoder()
    for body, reason in (
        ([str(sent.satellite), "0", "0", parts[0], parts[1]], "length"), (["40", "0", "0", *parts], "satellite"),
        (["5", "0", "0", parts[1], *parts[1:]], "subframe"), (["5", "0", "0", "zz", *parts[1:]], "length"),
    ):  # fmt: skip
        assert decoded(encode.ascii_log("RAWEPHEMA", TIME, ",".join(body)), decoder) == []
        assert decoder.counters.rejected[f"novatel/RAWEPHEMA {reason}"] >= 1


def test_the_ionosphere_comes_back():
    parameters = KlobucharParameters("G", KLOBUCHAR.alpha, KLOBUCHAR.beta)
    assert only(encode.encode_ionosphere(parameters, TIME)) == parameters


@pytest.mark.parametrize("name", ["HEADING", "HEADING2"])
def test_headings_come_back(name: str):
    """Fixed and float ones; where there is none, no angle is told."""
    sent = ReceiverHeading(
        TIME, name, CarrierSolution.FIXED, heading_rad=radians(123.5), heading_sigma_rad=radians(0.2), pitch_rad=radians(-1.5),
        pitch_sigma_rad=radians(0.4), length_m=1.25, satellites=21, station="0007",
    )  # fmt: skip
    found = only(encode.encode_heading(sent, name))
    assert (found.source, found.solution, found.satellites, found.station) == (name, CarrierSolution.FIXED, 21, "0007")
    assert (found.heading_rad, found.pitch_rad, found.length_m) == pytest.approx((sent.heading_rad, sent.pitch_rad, 1.25), abs=1e-7)
    none = only(encode.encode_heading(ReceiverHeading(TIME, name, CarrierSolution.NONE, satellites=9), name))
    assert (none.valid, none.satellites, isnan(none.pitch_rad)) == (False, 9, True)


@given(fix=st.sampled_from([0, 3, 4, 5, 6]), lat=st.floats(-89.0, 89.0), lon=st.floats(-179.0, 179.0), height=st.floats(-100.0, 9000.0))
@settings(max_examples=30, deadline=None)
def test_positions_come_back(fix: int, lat: float, lon: float, height: float):
    sent = ReceiverFix(TIME, fix, radians(lat), radians(lon), height, 0.02, 0.03, None, 17)
    found = only(encode.encode_position(sent))
    assert (found.fix, found.satellites, found.time, found.velocity_ned_mps) == (fix, 17, TIME, None)
    if fix:
        assert (found.lat_rad, found.lon_rad, found.height_m) == pytest.approx((sent.lat_rad, sent.lon_rad, height), abs=1e-9)
        assert (found.horizontal_sigma_m, found.vertical_sigma_m) == pytest.approx((0.02, 0.03), rel=1e-6)


@given(name=st.sampled_from(sorted(NOVATEL_LOGS.values())), body=st.binary(max_size=250), seed=st.integers(0, 2**16))
@settings(max_examples=300, deadline=None)
def test_any_body_is_decoded_ignored_or_refused_with_a_reason(name: str, body: bytes, seed: int):
    """Random bodies, right in length and checksum, binary and as words; nothing raises."""
    decoder = NovatelDecoder()
    words = ",".join(str(int(b)) if b & 1 else f"{b:x}.5e{seed % 400}" for b in body)
    decoded(encode.binary_log(name, TIME, body), decoder)
    decoded(encode.ascii_log(f"{name}A", TIME, words), decoder)
    counters = decoder.counters
    refused = {k: v for k, v in counters.rejected.items() if not k.endswith("unknown signal")}
    assert counters.decoded.total() + counters.ignored.total() + sum(refused.values()) == 2
