"""Shapes that have broken other programs, one row each: where it was told, the bytes, and what they come to here.

Each goes through the whole decoder of a receiver's stream, between two good frames, which must come out. What is refused is refused for
the reason given; what is understood gives what is in its bytes and nothing else.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from rtkmesh.codecs import novatel_encode, unicore_encode
from rtkmesh.codecs.checksums import crc16
from rtkmesh.codecs.messages import MAX_IGNORED_KINDS, Frame, Message, Protocol
from rtkmesh.codecs.navigation import NavigationDecoder
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.codecs.rtcm3_encode import encode_station
from rtkmesh.codecs.rtcm3_encode import frame as rtcm3
from rtkmesh.codecs.sbf_encode import block
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.ubx import UbxDecoder
from rtkmesh.codecs.ubx_encode import frame as ubx
from rtkmesh.gnss.ephemeris import ReceiverFix, ReferenceStation
from rtkmesh.gnss.receiver import CorrectionUse, ReceiverVersion
from rtkmesh.gnss.time import GpsTime

NOW = GpsTime(2400, 7200.0)
STATION = ReferenceStation(station_id=7, position_ecef_m=(3784992.7, 901280.7, 5037095.9))
GOOD = encode_station(STATION)[0]
LONG = bytes(range(65, 91)) * 10


def nmea(text: str) -> bytes:
    check = 0
    for character in text.encode():
        check ^= character
    return f"${text}*{check:02X}\r\n".encode()


def bits(*fields: tuple[int, int]) -> bytes:
    """Return fields (value, width) as the payload of an RTCM 3 message."""
    value, size = 0, 0
    for field, width in fields:
        value, size = value << width | field & (1 << width) - 1, size + width
    return (value << -size % 8).to_bytes(-(-size // 8), "big")


def msm7(satellites: int, signals: int, cells: int, *, rest: int = 0) -> bytes:
    """Return MSM7 of GPS with these masks (numbers of ones) and so many bytes behind them."""
    masks = ((1 << satellites) - 1 << 64 - satellites, 64), ((1 << signals) - 1 << 32 - signals, 32)
    head = (1077, 12), (7, 12), (7_200_000, 30), (0, 1), (0, 3), (0, 7), (0, 2), (0, 2), (0, 1), (0, 3), *masks
    return rtcm3(bits(*head, ((1 << cells) - 1, min(satellites * signals, 64))) + bytes(rest))


def rawx(count: int, rows: int) -> bytes:
    return ubx(0x02, 0x15, struct.pack("<dHbBBB2x", 7200.0, 2400, 18, count, 1, 1) + bytes(32 * rows))


def sfrbx(words: int, sent: int, *, gnss: int = 0, satellite: int = 5) -> bytes:
    return ubx(0x02, 0x13, struct.pack("<BBBBBBBB", gnss, satellite, 0, 0, words, 0, 2, 0) + bytes(4 * sent))


def descriptors(number: int, *lengths: int, sent: int = 1000) -> bytes:
    """Return 1007, 1008 or 1033 whose texts claim these lengths."""
    body = bits((number, 12), (7, 12))
    for index, length in enumerate(lengths):
        body += bytes([length]) + LONG[: min(length, sent)] + (b"\x00" if index == 0 else b"")
    return rtcm3(body[: 3 + sent])


def sbf(number: int, length: int, fields: bytes) -> bytes:
    """Return a block that says any length of itself; its checksum is over what is there."""
    covered = struct.pack("<HH", number, length) + fields
    return b"$@" + crc16(covered).to_bytes(2, "little") + covered


def meas_epoch(blocks: int, first: int, further: int, sub_blocks: bytes) -> bytes:
    """Return MeasEpoch that claims so many sub-blocks of these lengths."""
    return block("4027", NOW, bytes((blocks, first, further, 0, 0, 0)) + sub_blocks)


def oem(name: str, count: int, rest: bytes) -> bytes:
    return novatel_encode.binary_log(name, NOW, count.to_bytes(4, "little") + rest)


def unicore(name: str, count: int, rest: bytes) -> bytes:
    return unicore_encode.binary_log(name, NOW, count.to_bytes(4, "little") + rest)


WRAPS = 97612894  # 44 times this is 40 in 32 bits


@dataclass(frozen=True)
class Shape:
    """``refused``: the counter that goes up, empty where it is understood or none of ours; ``gives``: what must come out."""

    source: str
    data: bytes
    refused: str = ""
    gives: Callable[[list[Message]], bool] = lambda messages: not messages


def _texts(antenna: str) -> Callable[[list[Message]], bool]:
    return lambda messages: [m.antenna for m in messages if isinstance(m, ReferenceStation)] == [antenna]


SHAPES = {
    "ubx rawx: more measurements than bytes": Shape("gpsd work item 397 no. 5 (RXM-RAWX count outruns the payload)", rawx(255, 3), "ubx/02-15 length"),
    "ubx rawx: one measurement, no byte of it": Shape("gpsd work item 397 no. 5", rawx(1, 0), "ubx/02-15 length"),
    "ubx rawx: header cut": Shape("gpsd work item 397 no. 4 (short payloads are read past their end)", ubx(2, 0x15, bytes(15)), "ubx/02-15 length"),
    "ubx rawx: none at all": Shape("gpsd work item 397 no. 4", ubx(2, 0x15, b""), "ubx/02-15 length"),
    "ubx sbas: count outruns the payload": Shape("gpsd work item 397 no. 6 (NAV-SBAS)", ubx(1, 0x32, bytes(8) + b"\xff" + bytes(3))),
    "ubx sfrbx: more words than bytes": Shape("RTKLIB rcvraw, number of words from the wire", sfrbx(255, 2), "ubx/02-13 length"),
    "ubx sfrbx: no words": Shape("RTKLIB rcvraw", sfrbx(0, 0)),
    "ubx sfrbx: satellite 255 of system 255": Shape("RTKLIB rcvraw, satellite as an index", sfrbx(10, 10, gnss=255, satellite=255), "ubx/02-13 satellite"),
    "ubx sfrbx: GLONASS 255 (unknown)": Shape("u-blox F9 HPG 1.32, 3.17.9: svId 255", sfrbx(4, 4, gnss=6, satellite=255), "ubx/02-13 satellite"),
    "ubx pvt: cut": Shape("PX4-GPSDrivers PR 176 (length checked in part only)", ubx(1, 7, bytes(40)), "ubx/01-07 length"),
    "ubx rxm-rtcm: far too long": Shape("PX4-GPSDrivers PR 176 (RXM-RTCM)", ubx(2, 0x32, bytes(2000)), "", lambda messages: messages == [CorrectionUse(0, 0, 0, False, None)]),
    "ubx mon-ver: unterminated strings": Shape("PX4-Autopilot PR 28583 (MON-VER)", ubx(0x0A, 4, LONG[:220]), "", lambda messages: [type(m) for m in messages] == [ReceiverVersion] and max(map(len, messages[0].extensions)) == 30),
    "ubx: length 65535": Shape("PX4-Autopilot PR 24491 (a wrong length swallows what follows)", b"\xb5\x62\x02\x15\xff\xff"),
    "ubx: length 0, no payload": Shape("length 0 minus something: CVE-2025-67269 (gpsd packet.c)", ubx(1, 7, b""), "ubx/01-07 length"),
    "rtcm3: length 0": Shape("CVE-2025-67269 (gpsd: length underflow, endless loop)", rtcm3(b""), "rtcm3 too short"),
    "rtcm3: length 1": Shape("CVE-2025-67269", rtcm3(b"\x43"), "rtcm3 too short"),
    "rtcm3: length 1023, nothing follows": Shape("PX4-Autopilot PR 24491 (invalid RTCM 3 length)", b"\xd3\x03\xff\x43\x50"),
    "rtcm3 1005: two bytes": Shape("RTKLIB rtcm3.c, position messages", rtcm3(bits((1005, 12), (7, 12))), "rtcm3/1005 too short"),
    "rtcm3 1007: text of 255 in 3 bytes": Shape("RTKLIB 1007 (reliability study: out of bounds under ASan)", descriptors(1007, 255, sent=3), "rtcm3/1007 too short"),
    "rtcm3 1008: second text outruns": Shape("RTKLIB 1008 (the same)", descriptors(1008, 10, 255, sent=30), "rtcm3/1008 too short"),
    "rtcm3 1033: texts of 255": Shape("RTKLIB #799 (191 bytes written beyond 64)", descriptors(1033, 255, 255, 255, 100, 100), "", _texts(LONG[:255].decode())),
    "rtcm3 1033: fifth text outruns": Shape("RTKLIB #799", descriptors(1033, 9, 9, 9, 9, 255, sent=50), "rtcm3/1033 too short"),
    "rtcm3 1029: more characters than bytes": Shape("RTCM 10403.3 1029, counts of characters and bytes", rtcm3(bits((1029, 12), (7, 12), (60000, 16), (0, 17), (127, 7), (255, 8)))),
    "rtcm3 1019: cut": Shape("RTKLIB convbin crash on 1019", rtcm3(bits((1019, 12), (5, 6))), "rtcm3/1019 too short"),
    "rtcm3 1019: satellite 0": Shape("RTKLIB, satellite number as an index", rtcm3(bits((1019, 12), (0, 6), (0, 470))), "rtcm3/1019 satellite or time out of range"),
    "rtcm3 1020: satellite 63": Shape("RTKLIB 1020, satellite number as an index", rtcm3(bits((1020, 12), (63, 6), (0, 342))), "rtcm3/1020 satellite, time or position out of range"),
    "rtcm3 msm: 64 satellites of 32 signals": Shape("RTKLIB MSM, cells beyond 64", msm7(64, 32, 64, rest=800), "rtcm3/1077 more than 64 cells"),
    "rtcm3 msm: 5 satellites of 13 signals": Shape("RTKLIB MSM, 65 cells", msm7(5, 13, 64, rest=900), "rtcm3/1077 more than 64 cells"),
    "rtcm3 msm: 64 cells and no bytes of them": Shape("RTKLIB 1084, 1087 (reliability study)", msm7(8, 8, 64), "rtcm3/1077 too short"),
    "rtcm3 msm: header cut": Shape("RTKLIB MSM header", rtcm3(bits((1087, 12), (7, 12), (5, 30))), "rtcm3/1087 too short"),
    "rtcm3 1004: 31 satellites, one sent": Shape("RTKLIB legacy observations, count from the wire", rtcm3(bits((1004, 12), (7, 12), (7_200_000, 30), (0, 1), (31, 5), (0, 4), (0, 125))), "rtcm3/1004 too short"),
    "rtcm3 1012: 31 satellites, none sent": Shape("RTKLIB legacy observations", rtcm3(bits((1012, 12), (7, 12), (1, 27), (0, 1), (31, 5), (0, 4))), "rtcm3/1012 too short"),
    "rtcm3 1230: biases announced, none sent": Shape("RTKLIB 1230", rtcm3(bits((1230, 12), (7, 12), (0, 4), (15, 4))), "rtcm3/1230 too short"),
    "rtcm3 ssr 1059: cut behind its count": Shape("CVE-2026-56787 (RTKLIB #798, decode_ssr3)", rtcm3(bits((1059, 12), (0, 20), (63, 6), (31, 5)))),
    "nmea gsv: 200 satellites": Shape("PX4-Autopilot #28348 ($GPGSV,1,1,200 ends the autopilot)", nmea("GPGSV,1,1,200")),
    "nmea gsv: page 11 of 11": Shape("PX4-Autopilot PR 28583 (page number as an index)", nmea("GPGSV,11,11,44,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16")),
    "nmea: field of 200 characters": Shape("CVE-2026-29974 (minmea #102), CVE-2018-17937 (gpsd)", nmea("GPTXT,01,01,02," + "A" * 200)),
    "nmea: 1100 characters": Shape("CVE-2018-17937 (gpsd: over-long strings)", nmea("GPTXT," + "A" * 1100)),
    "nmea gga: fields of 15 digits": Shape(
        "betaflight #15634 (high precision overruns a field)", nmea("GNGGA,020000.000000000,4717.113990000000,N,00833.915900000000,E,4,08,1.01,499.600000000000,M,48.0000000000,M,,"), "",
        lambda messages: len(messages) == 1 and isinstance(messages[0], ReceiverFix) and abs(messages[0].height_m - 547.6) < 1e-9,
    ),
    "nmea gga: three fields": Shape("gpsd work item 397 no. 2 (missing fields)", nmea("GNGGA,020000,4717.1"), "nmea/GNGGA field"),
    "nmea rmc: format characters": Shape("gpsd work item 397 no. 2 (format string)", nmea("GNRMC,%s%n,A,%n,N,%x,E,,,%s,,"), "nmea/GNRMC field"),
    "sbf: length 0": Shape("rtklibexplorer/RTKLIB PR 80 (block length 0 is not refused)", sbf(4027, 0, bytes(12))),
    "sbf: length 7": Shape("rtklibexplorer/RTKLIB PR 80", sbf(4027, 7, bytes(12))),
    "sbf: length not a multiple of four": Shape("mosaic-X5 reference guide 4.1.1", sbf(4027, 22, bytes(14))),
    "sbf: length 65532": Shape("PX4-Autopilot PR 24491 (a wrong length swallows what follows)", sbf(4027, 65532, bytes(12))),
    "sbf MeasEpoch: no byte behind the time": Shape("rtklibexplorer/RTKLIB PR 475 (no bounds were checked)", block("4027", NOW, b""), "sbf/4027 length"),
    "sbf MeasEpoch: 255 sub-blocks, one sent": Shape("rtklibexplorer/RTKLIB PR 475", meas_epoch(255, 20, 12, bytes(20)), "sbf/4027 length"),
    "sbf MeasEpoch: sub-blocks of length 0": Shape("CVE-2025-67269 (gpsd: a length of 0 never ends)", meas_epoch(255, 0, 0, bytes(40)), "sbf/4027 length"),
    "sbf MeasEpoch: sub-block beyond the block": Shape("rtklibexplorer/RTKLIB PR 475", meas_epoch(1, 255, 12, bytes(20)), "sbf/4027 length"),
    "sbf MeasEpoch: 255 further signals of length 0": Shape("CVE-2025-67269", meas_epoch(1, 20, 0, bytes(19) + b"\xff"), "sbf/4027 length"),
    "sbf GPSRawCA: cut": Shape("rtklibexplorer/RTKLIB PR 475", block("4017", NOW, bytes(10)), "sbf/4017 length"),
    "unicore: length 65535": Shape("PX4-Autopilot PR 24491", b"\xaa\x44\xb5\x00\x0c\x00\xff\xff" + bytes(16)),
    "unicore OBSVM: count that wraps": Shape("RTKLIB #361 (integer overflow in the check of a length)", unicore("OBSVM", WRAPS, bytes(40)), "unicore/OBSVMB length"),
    "unicore OBSVMCMP: count -1": Shape("RTKLIB #361", unicore("OBSVMCMP", 0xFFFFFFFF, bytes(24)), "unicore/OBSVMCMPB length"),
    "unicore OBSVM: no count": Shape("RTKLIB #361", unicore_encode.binary_log("OBSVM", NOW, b"\x01"), "unicore/OBSVMB length"),
    "novatel: length 65535": Shape("ArduPilot #34150 (header and payload confused in the check of a length)", b"\xaa\x44\x12\x1c\x2b\x00\x00\x20\xff\xff" + bytes(18)),
    "novatel: header of 0 bytes": Shape("ArduPilot #34150 (an index less the header's length)", b"\xaa\x44\x12\x00\x2b\x00\x00\x20\x00\x00" + bytes(18)),
    "novatel: header of 255 bytes": Shape("ArduPilot #34150", b"\xaa\x44\x12\xff\x2b\x00\x00\x20\x00\x00" + bytes(18)),
    "novatel RANGE: count that wraps": Shape("RTKLIB #361 (44 times 97612894 is 40)", oem("RANGE", WRAPS, bytes(40)), "novatel/RANGEB length"),
    "novatel RANGECMP: count -1": Shape("RTKLIB #361", oem("RANGECMP", 0xFFFFFFFF, bytes(24)), "novatel/RANGECMPB length"),
    "novatel RANGE: no count": Shape("RTKLIB #361", novatel_encode.binary_log("RANGE", NOW, b""), "novatel/RANGEB length"),
    "novatel RAWEPHEM: cut": Shape("RTKLIB novatel.c, lengths of logs", novatel_encode.binary_log("RAWEPHEM", NOW, bytes(60)), "novatel/RAWEPHEMB length"),
    "nmea: nothing between $ and *": Shape("ArduPilot #34136 (stored before the checksum is checked)", b"$*00\r\n"),
    "nmea: checksum of one digit": Shape("ArduPilot #34136", b"$GNGGA,1*5\r\n"),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_a_known_shape_comes_to_what_it_must(shape: Shape):
    """Between two good frames; in one piece and byte by byte."""
    behind = encode_station(ReferenceStation(station_id=8, position_ecef_m=STATION.position_ecef_m))[0]
    whole = GOOD + shape.data + behind * 3
    for pieces in ([whole], [whole[i : i + 1] for i in range(len(whole))]):
        decoder = StreamDecoder(StreamOptions(approximate_time=NOW))
        messages = [message for piece in pieces for _, found in decoder.feed(piece) for message in found] + decoder.flush()
        stations = [m for m in messages if isinstance(m, ReferenceStation) and m.position_ecef_m is not None]
        assert [m.station_id for m in stations] == [7, 8] or shape.gives(messages[1:-1])
        assert shape.gives([m for m in messages if m not in stations or m.antenna])
        refused = {name for name, count in decoder.decoding.rejected.items() if count}
        assert refused == ({shape.refused} if shape.refused else set())


@pytest.mark.parametrize("claimed", [999, 65, 2])
def test_a_rinex_epoch_with_fewer_satellites_than_it_claims(claimed: int):
    """RTKLIB #796: the number of satellites of an epoch counted beyond its arrays."""
    head = f"{'     3.04           OBSERVATION DATA    G':<60}RINEX VERSION / TYPE\n{'G    1 C1C':<60}SYS / # / OBS TYPES\n{'':<60}END OF HEADER\n"
    text = (
        head
        + f"> 2024 06 24 02 00  0.0000000  0{claimed:3d}\nG05  20000000.000\n"
        + "> 2024 06 24 02 00 30.0000000  0  1\nG05  20000001.000\n"
    )
    reader = ObservationReader(text)
    epochs = list(reader)
    assert all(np.isfinite(epoch.pseudorange_m).all() and len(epoch) == 1 for epoch in epochs)
    assert len(epochs) <= 2
    assert reader.counters.rejected


def test_kinds_beyond_number_share_a_counter():
    """Found by our own fuzzing: 65536 kinds filled memory, and made the status too large to be sent."""
    decoder = StreamDecoder(StreamOptions(approximate_time=NOW))
    for number in range(3000):
        decoder.feed(ubx(number >> 8 | 0x80, number & 255, b"") + rtcm3(bits((number + 1090 & 0xFFF, 12), (0, 12))))
    ignored, frames = decoder.decoding.ignored, decoder.framing.frames
    assert frames.total() == 6000
    assert len(frames) <= 2004
    assert all(len(counters) <= MAX_IGNORED_KINDS + 1 for counters in (decoder._ubx.counters.ignored, decoder._rtcm3.counters.ignored))
    assert ignored["ubx/other"] == 3000 - MAX_IGNORED_KINDS
    assert frames["ubx/other"] > 0


def test_a_jump_of_the_time_costs_some_satellites_at_a_time_and_all_in_the_end():
    """Found by our own fuzzing: a frame with a wrong time had the ephemerides of all satellites made anew, 2 ms and more."""
    asked: list[int] = []
    decoder = NavigationDecoder(NOW)
    decoder._messages = dict.fromkeys(range(1, 61), 0)
    decoder._publish = lambda satellite, _: asked.append(satellite) or []  # type: ignore[method-assign]
    counts = []
    for seconds in range(4):
        decoder.set_time(GpsTime(2390, 100.0 + seconds))
        counts.append(len(asked))
    assert counts == [24, 48, 60, 60]
    assert asked == list(range(1, 61))


def test_ubx_frames_that_are_shorter_than_their_header_never_reach_a_decoder():
    """A decoder that is handed such a frame all the same refuses it."""
    decoder = UbxDecoder(NOW)
    for kind in ("02-15", "02-13", "01-07"):
        assert decoder.decode(Frame(Protocol.UBX, kind, ubx(int(kind[:2], 16), int(kind[3:], 16), b""))) == []
    assert decoder.counters.rejected.total() == 3


def test_good_frames_are_good():
    """The frames around the shapes above are what they are taken for."""
    decoder = StreamDecoder(StreamOptions(approximate_time=NOW))
    [(_, [message])] = decoder.feed(GOOD)
    assert message == ReferenceStation(station_id=7, position_ecef_m=STATION.position_ecef_m, source="rtcm3")
