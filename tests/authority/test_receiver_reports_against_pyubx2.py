"""What receivers tell of themselves, against pyubx2's reading of the same frames: recordings, and payloads of any content."""

import gzip
from collections import Counter
from collections.abc import Callable
from math import degrees, isnan
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyubx2 import UBXReader

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.ubx import UbxDecoder
from rtkmesh.codecs.ubx_encode import frame
from rtkmesh.codecs.ubx_receiver import READERS
from rtkmesh.gnss.receiver import (
    CommandAnswer,
    CorrectionUse,
    EventMark,
    PortsHealth,
    ReceiverHeading,
    ReceiverReport,
    ReceiverVersion,
    RfHealth,
    SatellitesInView,
    SurveyIn,
)
from rtkmesh.gnss.signals import satellite_id
from rtkmesh.gnss.time import GpsTime

SAMPLES = 12  # of each kind and recording
PART_M = 1e-4
NEAR = GpsTime(2300, 100_000.0)
# Lengths of the payloads: fixed, or header and repeated row, with the place of the count.
LENGTHS: dict[str, tuple[int, int, int]] = {
    "01-3c": (64, 0, 0), "01-3b": (40, 0, 0), "01-35": (8, 12, 5), "0d-03": (28, 0, 0), "0a-09": (60, 0, 0), "0a-38": (4, 24, 1),
    "0a-36": (8, 40, 1), "0a-04": (100, 0, 0), "02-32": (8, 0, 0), "05-01": (2, 0, 0), "05-00": (2, 0, 0),
}  # fmt: skip
EARLY_RADIO_BYTES = 20  # of a block
SYSTEM_LETTERS = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J", 6: "R", 7: "I"}


def rows(message: Any, count: int, *names: str) -> list[tuple[Any, ...]]:
    return [tuple(getattr(message, f"{name}_{k:02d}") for name in names) for k in range(1, count + 1)]


def same(found: float, expected: float) -> bool:
    return found == pytest.approx(expected, rel=1e-9, abs=1e-9)


def check_heading(found: ReceiverHeading, message: Any) -> None:
    """pyubx2 adds the parts of high precision and gives centimetres and degrees."""
    valid = bool(message.gnssFixOK and message.relPosValid)
    pointing = valid and message.version > 0 and bool(message.relPosHeadingValid)
    known = valid and not (message.version > 0 and message.relPosNormalized)
    assert (found.solution, found.station) == (min(message.carrSoln, 2), str(message.refStationID))
    assert found.extrapolated == bool(message.refPosMiss or message.refObsMiss)
    assert found.valid == pointing
    assert (found.baseline_ned_m is not None) == known
    if pointing:
        assert same(degrees(found.heading_rad) % 360.0, message.relPosHeading % 360.0)
        assert same(degrees(found.heading_sigma_rad), message.accHeading)
    if found.baseline_ned_m is not None and found.baseline_sigma_ned_m is not None:
        assert all(same(v * 100, getattr(message, f"relPos{axis}")) for v, axis in zip(found.baseline_ned_m, "NED", strict=True))
        assert all(same(v * 1e3, getattr(message, f"acc{axis}")) for v, axis in zip(found.baseline_sigma_ned_m, "NED", strict=True))


def check_survey(found: SurveyIn, message: Any) -> None:
    assert (found.active, found.valid, found.duration_s) == (bool(message.active), bool(message.valid), message.dur)
    assert found.observations == message.obs
    assert (found.position_ecef_m is None) == (message.obs == 0)
    if found.position_ecef_m is not None:
        parts = [(getattr(message, f"mean{axis}"), getattr(message, f"mean{axis}HP")) for axis in "XYZ"]
        assert all(same(v, cm / 100 + part * PART_M) for v, (cm, part) in zip(found.position_ecef_m, parts, strict=True))
        assert same(found.accuracy_m, message.meanAcc / 1e4)


def check_satellites(found: SatellitesInView, message: Any) -> None:
    names = ("gnssId", "svId", "cno", "elev", "azim", "prRes", "qualityInd", "svUsed", "health", "diffCorr")
    expected = rows(message, message.numSvs, *names)
    listed = {satellite_id(row.satellite): row for row in found.satellites}
    for gnss, sv, cn0, elevation, azimuth, residual, quality, used, health, corrected in expected:
        number = sv - {1: 100}.get(gnss, 0)
        row = listed.get(f"{SYSTEM_LETTERS.get(gnss, '?')}{number:02d}")
        if row is None or len(listed) < message.numSvs:  # not a satellite, or one that comes twice
            continue
        assert (row.quality, row.used, row.corrected) == (quality, bool(used), bool(corrected))
        assert row.healthy == {1: True, 2: False}.get(health)
        assert isnan(row.cn0_dbhz) if cn0 == 0 else row.cn0_dbhz == cn0
        assert same(row.residual_m, residual)  # pyubx2 has multiplied it by 0.1
        if -90 <= elevation <= 90:
            assert same(degrees(row.elevation_rad), elevation)
            assert same(degrees(row.azimuth_rad), azimuth % 360)


def check_mark(found: EventMark, message: Any) -> None:
    assert (found.channel, found.count) == (message.ch, message.count)
    assert same(found.accuracy_s, message.accEst * 1e-9)
    for edge, week, tow_ms, part_ns, new in (
        (found.rising, message.wnR, message.towMsR, message.towSubMsR, message.newRisingEdge),
        (found.falling, message.wnF, message.towMsF, message.towSubMsF, message.newFallingEdge),
    ):
        if edge is None or message.timeBase != 1:
            continue
        assert new
        assert message.time
        assert same(edge - GpsTime(week, tow_ms / 1e3), part_ns * 1e-9)


def check_radio(found: RfHealth, message: Any) -> None:
    """Numbers in the order of the interface description."""
    antennas, jamming = ["initialising", "unknown", "ok", "short", "open"], ["unknown", "ok", "warning", "critical"]
    if found.source == "MON-RF":
        names = ("blockId", "antStatus", "antPower", "jammingState", "jamInd", "agcCnt", "noisePerMS")
        expected = rows(message, message.nBlocks, *names)
    else:
        expected = [(0, message.aStatus, message.aPower, message.jammingState, message.jamInd, message.agcCnt, message.noisePerMS)]
    assert len(found.blocks) == len(expected)
    for row, (block, antenna, power, state, indicator, gain, noise) in zip(found.blocks, expected, strict=True):
        assert (row.block, row.noise) == (block, noise)
        assert row.antenna == (antennas[antenna] if antenna < 5 else "unknown")
        assert row.powered == {0: False, 1: True}.get(power)
        assert row.jamming == jamming[state]
        assert (row.jamming_indicator, row.gain) == pytest.approx((indicator / 255, gain / 8191))


def check_ports(found: PortsHealth, message: Any) -> None:
    assert (found.memory_full, found.buffer_full) == (bool(message.mem), bool(message.alloc))
    names = ("txPending", "txBytes", "txUsage", "rxPending", "rxBytes", "rxUsage", "overrunErrs", "skipped")
    for row, (tx, sent, load, rx, received, use, overruns, skipped) in zip(found.ports, rows(message, message.nPorts, *names), strict=True):
        assert (row.sent_pending, row.sent_bytes, row.received_pending, row.received_bytes) == (tx, sent, rx, received)
        assert (row.sent_load, row.received_load) == pytest.approx((load / 100, use / 100))
        assert (row.overruns, row.skipped_bytes) == (overruns, skipped)


def check_version(found: ReceiverVersion, message: Any) -> None:
    clean = [bytes(text).split(b"\0")[0] for text in (message.swVersion, message.hwVersion)]
    if all(32 <= byte < 127 for text in clean for byte in text):
        assert [found.software.encode(), found.hardware.encode()] == clean


def check_corrections(found: CorrectionUse, message: Any) -> None:
    assert (found.message, found.station_id) == (message.msgType, message.refStation)
    assert (found.subtype, found.failed_crc) == (message.subType, bool(message.crcFailed))
    assert found.used == ({1: False, 2: True}.get(message.msgUsed) if message.version >= 2 else None)


def check_answer(found: CommandAnswer, message: Any) -> None:
    assert found.command == f"ubx {message.clsID:02x}-{message.msgID:02x}"
    assert found.accepted == (message.identity == "ACK-ACK")


CHECKS: dict[type, Callable[[Any, Any], None]] = {
    ReceiverHeading: check_heading,
    SurveyIn: check_survey,
    SatellitesInView: check_satellites,
    EventMark: check_mark,
    RfHealth: check_radio,
    PortsHealth: check_ports,
    ReceiverVersion: check_version,
    CorrectionUse: check_corrections,
    CommandAnswer: check_answer,
}


def check(part: Frame) -> ReceiverReport:
    """Compare one frame; its time is the time of week in the week near by."""
    (found,) = UbxDecoder(NEAR).decode(part)
    message = UBXReader.parse(part.data)
    assert isinstance(found, ReceiverReport)
    CHECKS[type(found)](found, message)
    if hasattr(message, "iTOW") and (time := getattr(found, "time", None)) is not None:
        assert same(time.tow_s, message.iTOW / 1e3 % 604_800)
    return found


def test_every_message_is_compared():
    """No message was added without its comparison."""
    assert set(LENGTHS) == set(READERS)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("galway_m8p/base-20181004-1236.ubx.gz", {"01-3b": 702}),
        ("galway_m8p/rover-20181004-1532.ubx.gz", {"01-3b": 1180, "0d-03": 635}),
        ("galway_m8p/base-20181015-1654.ubx.gz", {"01-3b": 3687, "05-01": 19}),
        ("dec_rtcm3/pygpsdata-rtcm3.log", {"01-3b": 16}),
        ("dec_ubx/rxm_sfrbx_glo.ubx", {"01-35": 9, "0a-09": 9}),
        ("dec_gpsd/ublox-zed-f9r.log", {"01-35": 30}),
        ("dec_gpsd/ublox-zed-f9p-rtk.log", {"01-35": 10}),
    ],
)
def test_reports_of_recordings_are_those_of_pyubx2(data: Path, name: str, counts: dict[str, int]):
    """All frames are decoded; some of each kind, spread over the recording, have pyubx2's values."""
    content = (data / name).read_bytes()
    parts = Framer([Protocol.UBX]).feed(gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content)
    reports = [part for part in parts if part.kind in READERS and not is_early_radio(part)]
    assert Counter(part.kind for part in reports) == counts
    decoder = UbxDecoder(NEAR)
    assert sum(len(decoder.decode(part)) for part in reports) == len(reports)
    for kind in counts:
        same_kind = [part for part in reports if part.kind == kind]
        for part in same_kind[:: max(1, len(same_kind) // SAMPLES)]:
            check(part)


def is_early_radio(part: Frame) -> bool:
    """Return whether this is MON-RF of early firmware, whose shorter blocks pyubx2 does not know."""
    return part.kind == "0a-38" and len(part.data) - 8 == 4 + EARLY_RADIO_BYTES * part.data[7]


@pytest.mark.data
def test_early_firmware_has_shorter_radio_blocks(data: Path):
    """The F9R of this recording: two front ends in 20 bytes each."""
    parts = [part for part in Framer([Protocol.UBX]).feed((data / "dec_gpsd" / "ublox-zed-f9r.log").read_bytes()) if is_early_radio(part)]
    for part in parts:
        (found,) = UbxDecoder().decode(part)
        assert isinstance(found, RfHealth)
        assert [row.block for row in found.blocks] == [0, 1]
        assert all(row.antenna == "ok" and row.powered is None and row.jamming == "ok" for row in found.blocks)
        assert [0.0 < row.jamming_indicator < 0.3 and 0.5 < row.gain < 0.7 for row in found.blocks] == [True, True]
    assert len(parts) == 7


@st.composite
def payloads(draw: st.DrawFn) -> tuple[str, bytes]:
    """Return a message and a payload of the right length with any content."""
    kind = draw(st.sampled_from(sorted(LENGTHS)))
    size, row, place = LENGTHS[kind]
    count = draw(st.integers(0, 4)) if row else 0
    payload = bytearray(draw(st.binary(min_size=size + count * row, max_size=size + count * row)))
    if row:
        payload[place] = count
    if kind == "01-3c":
        payload[0] = 1
    return kind, bytes(payload)


def built(kind: str, payload: bytes) -> Frame:
    message_class, message_id = bytes.fromhex(kind.replace("-", ""))
    return Frame(Protocol.UBX, kind, frame(message_class, message_id, payload))


@given(sample=payloads())
@settings(max_examples=400, deadline=None)
def test_random_payloads_are_read_as_pyubx2_reads_them(sample: tuple[str, bytes]):
    """All values of all fields."""
    check(built(*sample))


@given(kind=st.sampled_from(sorted(READERS)), payload=st.binary(max_size=120))
@settings(max_examples=400, deadline=None)
def test_any_payload_is_a_value_or_a_reason(kind: str, payload: bytes):
    """Payloads of any length never raise; too short ones are counted."""
    decoder = UbxDecoder(NEAR)
    found = decoder.decode(built(kind, payload))
    assert len(found) == decoder.counters.decoded.total() == 1 - decoder.counters.rejected.total()


def test_without_a_time_there_is_none():
    """A time of week alone is no instant."""
    (found,) = UbxDecoder().decode(built("01-3b", bytes(40)))
    assert isinstance(found, SurveyIn)
    assert found.time is None
    assert found.position_ecef_m is None
    assert isnan(found.accuracy_m)


def test_a_heading_is_valid_only_when_the_receiver_says_so():
    """Zero degrees without the flags is no north."""
    payload = bytearray(64)
    payload[0] = 1
    payload[20:24] = (100).to_bytes(4, "little")
    for flags, valid in ((0, False), (0x101, False), (0x105, True), (0x104, False), (0x5, False)):
        payload[60:64] = flags.to_bytes(4, "little")
        (found,) = UbxDecoder(NEAR).decode(built("01-3c", bytes(payload)))
        assert isinstance(found, ReceiverHeading)
        assert found.valid is valid


def test_event_marks_are_told_in_gps_time():
    """Edges in UTC are turned; those in the receiver's own time, old ones and invalid ones are none."""

    def mark(flags: int) -> EventMark:
        numbers = b"".join(number.to_bytes(4, "little") for number in (5_000, 250_000, 6_000, 500_000, 20))
        (found,) = UbxDecoder().decode(built("0d-03", bytes((1, flags, 7, 0)) + (2300).to_bytes(2, "little") * 2 + numbers))
        assert isinstance(found, EventMark)
        return found

    both = 0x80 | 4 | 0x40
    assert mark(both | 1 << 3).rising == GpsTime(2300, 5.00025)
    assert mark(both | 1 << 3).falling == GpsTime(2300, 6.0005)
    assert mark(both | 2 << 3).rising == GpsTime(2300, 23.00025)
    assert mark(both).rising is None
    assert mark(0x80 | 1 << 3).rising is None
    assert mark(0x40 | 4 | 1 << 3).rising is None
