"""Framing of mixed streams: nothing good is lost, nothing bad gets through, and cutting the stream changes nothing."""

import struct
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.checksums import CRC24Q_POLYNOMIAL, crc24q, crc24q_range, crc32, crc32_range, fletcher16, fletcher16_range
from rtkmesh.codecs.framing import LONGEST_FRAME, RTCM3_OVERHEAD, UBX_MAX_PAYLOAD, Framer
from rtkmesh.codecs.messages import Protocol


def as_array(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8)


def ubx(message_class: int, message_id: int, payload: bytes) -> bytes:
    body = bytes((message_class, message_id)) + len(payload).to_bytes(2, "little") + payload
    return b"\xb5\x62" + body + fletcher16(as_array(body)).to_bytes(2, "little")


def rtcm3(number: int, rest: bytes) -> bytes:
    payload = (number << 4).to_bytes(2, "big") + rest
    body = b"\xd3" + len(payload).to_bytes(2, "big") + payload
    return body + crc24q(as_array(body)).to_bytes(3, "big")


def nmea(text: str, end: str = "\r\n") -> bytes:
    checksum = 0
    for character in text.encode():
        checksum ^= character
    return f"${text}*{checksum:02X}{end}".encode()


def unicore(number: int, payload: bytes) -> bytes:
    header = b"\xaa\x44\xb5" + struct.pack("<BHHBBHIIBBH", 77, number, len(payload), 0, 1, 2400, 1000, 0, 0, 18, 5)
    return header + payload + crc32(header + payload).to_bytes(4, "little")


def ascii_log(text: str, end: str = "\r\n") -> bytes:
    return f"#{text}*{crc32(text.encode()):08x}{end}".encode()


def all_frames(data: bytes, framer: Framer | None = None) -> list[bytes]:
    framer = framer or Framer()
    return [frame.data for frame in framer.feed(data) + framer.flush()]


GOOD = st.one_of(
    st.builds(ubx, st.integers(0, 255), st.integers(0, 255), st.binary(max_size=40)),
    st.builds(rtcm3, st.integers(0, 4095), st.binary(max_size=40)),
    st.text("0123456789.,NEW", max_size=40).map(lambda text: nmea("GNGGA," + text)),
    st.builds(unicore, st.integers(0, 65535), st.binary(max_size=40)),
    st.text("0123456789.,;NEW", max_size=40).map(lambda text: ascii_log("BESTNAVA,68,GPS,FINE,2433,239990400,0,0,18,9;" + text)),
)


def test_frames_of_receivers_logs_come_in_order_with_their_kinds():
    """Unicore's binary and ASCII logs by name, NovAtel's form of ASCII logs apart, replies to commands of both forms."""
    reply = b"#MODE,97,GPS,FINE,2190,365174000,0,0,18,12;MODE ROVER"
    parts = [
        unicore(12, b"abc"),
        ascii_log("UNIHEADINGA,78,GPS,FINE,2428,0,0,0,18,11;NONE"),
        unicore(54321, b""),
        ascii_log("BESTPOSA,COM1,0,95.0;X", "\n"),
        reply + b"*%02X\r\n" % xor(reply),
        nmea("command,MODE ROVER,response: OK"),
    ]
    framer = Framer()
    frames = framer.feed(b"".join(parts))
    assert [frame.data for frame in frames] == parts
    assert [(f.protocol.value, f.kind) for f in frames] == [
        ("unicore", "OBSVMB"), ("unicore", "UNIHEADINGA"), ("unicore", "54321"), ("novatel", "BESTPOSA"), ("unicore", "MODE"),
        ("nmea", "command"),
    ]  # fmt: skip
    assert framer.counters.frames["unicore/OBSVMB"] == 1
    assert framer.counters.bytes_skipped == framer.pending == 0


def xor(data: bytes) -> int:
    check = 0
    for byte in data:
        check ^= byte
    return check


# Examples of the manufacturer and of its receivers, as public parsers of these logs quote them.
NO_HEADING = b'INSUFFICIENT_OBS,NONE,0.0000,0.0000,0.0000,0.0000,0.0000,0.0000,"",0,0,0,0,0,00,0,0'
UM982 = b'"UM982","R4.10Build15434","HRPT00-S10C-P","2310415000012-LR23A2225208904","ff2740966a10124c","2024/08/08"'
PUBLISHED = (
    b"#UNIHEADINGA,97,GPS,FINE,2190,365174000,0,0,18,12;" + NO_HEADING + b"*ee072604\r\n",
    b"#OBSVHA,97,GPS,FINE,2190,359897000,0,0,18,14;0*9d38304c\r\n",
    b"#VERSIONA,79,GPS,FINE,2326,378237000,15434,0,18,889;" + UM982 + b"*769fd54f\r\n",
)


@pytest.mark.parametrize("line", PUBLISHED)
def test_published_logs_have_their_checksums(line: bytes):
    """CRC-32 with initial value 0 and no inversion at the end, over what stands between # and *."""
    assert all_frames(b"#" + line + b"#") == [line]
    damaged = line.replace(b"GPS", b"GPT")
    framer = Framer()
    assert all_frames(damaged, framer) == []
    assert framer.counters.checksum_failures == {"unicore": 1}


@pytest.mark.data
def test_sentences_of_real_receivers_have_their_checksums(data: Path):
    """Seven lines of UM982 and UM482 boards (a lone LF ends them here)."""
    lines = (data / "dec_unicore" / "um982_sentences.txt").read_bytes()
    frames = Framer().feed(lines)
    assert [(f.protocol.value, f.kind) for f in frames] == [
        ("unicore", "UNIHEADINGA"), ("unicore", "BESTNAVA"), ("novatel", "HEADINGA"), *[("unicore", "UNIHEADINGA")] * 4,
    ]  # fmt: skip
    assert b"".join(f.data for f in frames) == lines


def test_a_log_of_the_other_form_is_none_when_only_one_is_asked_for():
    """Unicore's and NovAtel's ASCII logs begin alike; only the protocol asked for comes out."""
    n4, novatel = ascii_log("BESTNAVA,68,GPS,FINE,2433;X"), ascii_log("BESTPOSA,COM1,0,95.0;X")
    assert all_frames(n4 + novatel, Framer([Protocol.UNICORE])) == [n4]
    assert all_frames(n4 + novatel, Framer([Protocol.NOVATEL])) == [novatel]


@pytest.mark.parametrize(
    "line",
    [
        b"#bestnava,1;2*00000000\r\n", b"#BESTNAVA;1*00000000\r\n", b"#,1*00\r\n", b"#BESTNAVA,1*0000000\r\n", b"#BESTNAVA,1*00000000\rX",
        b"#BESTNAVA,\x80*00\r\n", b"#BESTNAVA,1" + b"1" * 40000, b"\xaa\x44\xb5\x00\x0c\x00\xff\xff",
    ],
)  # fmt: skip
def test_what_is_no_log_is_skipped(line: bytes):
    """Lower case names, no header, wrong number of digits, wrong end, foreign characters, endless lines, impossible lengths."""
    good = ascii_log("BESTNAVA,68,GPS,FINE,2433;X")
    assert all_frames(line + b"\n" + good) == [good]


def test_frames_of_three_protocols_come_in_order_with_their_kinds():
    """Each frame keeps its bytes and says what it is."""
    parts = [ubx(2, 0x15, b"abc"), rtcm3(1077, b"xyz"), nmea("GNGGA,1,2"), rtcm3(4072, b""), ubx(1, 7, b""), nmea("PUBX,00,1", "\n")]
    framer = Framer()
    frames = framer.feed(b"".join(parts))
    assert [frame.data for frame in frames] == parts
    assert [(f.protocol.value, f.kind) for f in frames] == [
        ("ubx", "02-15"), ("rtcm3", "1077"), ("nmea", "GNGGA"), ("rtcm3", "4072"), ("ubx", "01-07"), ("nmea", "PUBX"),
    ]  # fmt: skip
    assert framer.counters.frames["rtcm3/1077"] == 1
    assert framer.counters.bytes_skipped == framer.pending == 0


@given(pieces=st.lists(st.one_of(GOOD, st.binary(max_size=20)), max_size=8), cuts=st.lists(st.integers(0, 400), max_size=6))
@settings(max_examples=80, deadline=None)
def test_any_cut_of_the_stream_gives_the_same_frames_and_counters(pieces: list[bytes], cuts: list[int]):
    """Frames and counters depend on the bytes only."""
    data = b"".join(pieces)
    whole, cut = Framer(), Framer()
    expected = all_frames(data, whole)
    edges = [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    found = [frame.data for start, end in pairwise(edges) for frame in cut.feed(data[start:end])]
    assert found + [frame.data for frame in cut.flush()] == expected
    assert cut.counters == whole.counters
    assert sum(map(len, expected)) + whole.counters.bytes_skipped == whole.counters.bytes_in == len(data)


@given(before=GOOD, after=GOOD, bit=st.integers(0, 10_000))
@settings(max_examples=80, deadline=None)
def test_a_flipped_bit_costs_at_most_its_own_frame(before: bytes, after: bytes, bit: int):
    """A damaged frame is not accepted, and the good frame behind it is found."""
    damaged = bytearray(before)
    damaged[bit // 8 % len(before)] ^= 1 << bit % 8
    found = all_frames(bytes(damaged) + after)
    assert found[-1:] == [after]
    assert before not in found[:-1]


@given(data=st.binary(max_size=3000))
@settings(max_examples=60, deadline=None)
def test_random_bytes_never_raise_and_little_is_held_back(data: bytes):
    """Noise gives no exception and no more pending bytes than the longest frame has."""
    framer = Framer()
    framer.feed(data)
    assert framer.pending <= LONGEST_FRAME
    framer.flush()
    assert framer.pending == 0


@pytest.mark.parametrize("false_header", [b"\xb5\x62\x01\x02\xff\x1f", b"\xd3\x03\xff", b"$GN"])
def test_flush_gives_what_an_unfinished_false_header_was_hiding(false_header: bytes):
    """A false header in front of good frames only delays them."""
    good = [ubx(1, 7, b"1"), rtcm3(1005, b"2")]
    framer = Framer()
    early = framer.feed(false_header + b"".join(good))
    assert [f.data for f in early + framer.flush()] == good
    assert framer.counters.bytes_skipped == len(false_header)


def test_a_false_header_gives_way_as_soon_as_its_length_has_arrived():
    """The wait for a false header ends at its own length, and every good frame behind it comes out."""
    false_header = b"\xb5\x62\x01\x02" + (1000).to_bytes(2, "little")
    good = [rtcm3(1005, bytes([i]) * 30) for i in range(40)]
    framer = Framer()
    found = [f.data for f in framer.feed(false_header + b"".join(good))]
    assert found == good
    assert framer.counters.checksum_failures == {"ubx": 1}


def test_impossible_lengths_are_no_headers():
    """A length beyond the protocol's limit, or reserved bits that are set, never make the framer wait."""
    framer = Framer()
    framer.feed(b"\xb5\x62\x01\x02" + (UBX_MAX_PAYLOAD + 1).to_bytes(2, "little") + b"\xd3\xff\xff")
    assert framer.pending == 0


def test_only_the_protocols_asked_for_are_framed():
    """Bytes of other protocols count as skipped."""
    framer = Framer([Protocol.RTCM3])
    noise, good = ubx(1, 7, b"1234"), rtcm3(1005, b"2")
    assert all_frames(noise + good, framer) == [good]
    assert framer.counters.bytes_skipped == len(noise)


@pytest.mark.parametrize(
    "line",
    [b"$GNGGA,1*00\r\n", b"$GNGGA,1*7\r\n", b"$GNGGA,1\r\n", b"$GN\x80GA*00\r\n", nmea("GNGGA,1")[:-2] + b"\rX", nmea("X" * 2000)],
)
def test_sentences_without_a_right_checksum_and_end_are_skipped(line: bytes):
    """Wrong or missing checksum, foreign characters, wrong end, endless line."""
    good = nmea("GNRMC,2")
    assert all_frames(line + good) == [good]


def test_lower_case_checksums_are_read():
    """Some receivers write hexadecimal in lower case."""
    line = nmea("GNZDA,000001.00")
    assert all_frames(line[:-4] + line[-4:-2].lower() + b"\r\n") == [line[:-4] + line[-4:-2].lower() + b"\r\n"]


def test_crc24q_is_that_of_the_standard():
    """The check value of CRC-24/LTE-A's sibling CRC-24Q for '123456789' is CDE703."""
    assert crc24q(as_array(b"123456789")) == 0xCDE703


@given(data=st.binary(max_size=60), start=st.integers(0, 20))
@settings(max_examples=80, deadline=None)
def test_checksums_are_those_of_their_definitions(data: bytes, start: int):
    """Kernels that take several bytes at once against the bit by bit division and the running sums, of any part."""
    crc, a, b = 0, 0, 0
    for byte in data[start:]:
        crc ^= byte << 16
        for _ in range(8):
            crc = crc << 1 ^ (CRC24Q_POLYNOMIAL if crc & 0x800000 else 0)
        a = (a + byte) % 256
        b = (b + a) % 256
    end = max(start, len(data))
    assert (crc24q_range(data, start, end), fletcher16_range(data, start, end)) == (crc, a | b << 8)


@given(data=st.binary(max_size=60), start=st.integers(0, 20))
@settings(max_examples=80, deadline=None)
def test_crc32_is_zlibs_without_its_inversions(data: bytes, start: int):
    """The kernel that takes eight bytes at once against zlib, of any part."""
    end = max(start, len(data))
    assert crc32_range(data, start, end) == zlib.crc32(data[start:], 0xFFFFFFFF) ^ 0xFFFFFFFF


def test_a_long_stream_comes_out_over_many_batches():
    """More frames than one kernel call returns, among them empty ones."""
    frames = [rtcm3(i % 4096, b"") for i in range(3000)]
    assert all_frames(b"".join(frames)) == frames
    empty = b"\xd3\x00\x00" + crc24q(as_array(b"\xd3\x00\x00")).to_bytes(3, "big")
    assert len(empty) == RTCM3_OVERHEAD
    assert Framer().feed(empty)[0].kind == "0"
