"""Framing of mixed streams: nothing good is lost, nothing bad gets through, and cutting the stream changes nothing."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.checksums import CRC24Q_POLYNOMIAL, crc24q, crc24q_range, fletcher16, fletcher16_range
from rtkmesh.codecs.framing import RTCM3_OVERHEAD, UBX_MAX_PAYLOAD, UBX_OVERHEAD, Framer
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


def all_frames(data: bytes, framer: Framer | None = None) -> list[bytes]:
    framer = framer or Framer()
    return [frame.data for frame in framer.feed(data) + framer.flush()]


GOOD = st.one_of(
    st.builds(ubx, st.integers(0, 255), st.integers(0, 255), st.binary(max_size=40)),
    st.builds(rtcm3, st.integers(0, 4095), st.binary(max_size=40)),
    st.text("0123456789.,NEW", max_size=40).map(lambda text: nmea("GNGGA," + text)),
)


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
    assert framer.pending <= UBX_MAX_PAYLOAD + UBX_OVERHEAD
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
    assert framer.counters.checksum_failures == {"ubx": 1, "rtcm3": 0, "nmea": 0}


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


def test_a_long_stream_comes_out_over_many_batches():
    """More frames than one kernel call returns, among them empty ones."""
    frames = [rtcm3(i % 4096, b"") for i in range(3000)]
    assert all_frames(b"".join(frames)) == frames
    empty = b"\xd3\x00\x00" + crc24q(as_array(b"\xd3\x00\x00")).to_bytes(3, "big")
    assert len(empty) == RTCM3_OVERHEAD
    assert Framer().feed(empty)[0].kind == "0"
