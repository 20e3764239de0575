"""UBX messages: what each bit of RXM-RAWX means for an epoch, times, fixes, and damaged payloads."""

import struct
from dataclasses import dataclass
from itertools import pairwise
from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.messages import Frame, Message, Protocol
from rtkmesh.codecs.ubx import NAV_PVT, RAWX, SFRBX, UbxDecoder
from rtkmesh.codecs.ubx_encode import encode_ephemeris
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, ReceiverFix
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.sky import SATELLITES, broadcast

SENT = GpsTime(2445, 532_800.0)
PSEUDORANGE, PHASE, HALF_KNOWN, HALF_SUBTRACTED = 1, 2, 4, 8
GOOD = PSEUDORANGE | PHASE | HALF_KNOWN


def frame(kind: str, payload: bytes) -> Frame:
    """Return a frame as the framer hands it over (the decoder does not look at the checksum)."""
    return Frame(
        Protocol.UBX, kind, b"\xb5\x62" + bytes.fromhex(kind.replace("-", "")) + struct.pack("<H", len(payload) % 65536) + payload + b"\0\0"
    )


@dataclass
class Row:
    """One measurement of RXM-RAWX."""

    gnss: int = 0
    sv: int = 5
    sig: int = 0
    track: int = GOOD
    pseudorange_m: float = 2.2e7
    phase_cyc: float = 1.1e8
    doppler_hz: float = -1234.5
    freq: int = 0
    lock_ms: int = 5000
    cn0: int = 44
    code_sigma: int = 5
    phase_sigma: int = 2

    def pack(self) -> bytes:
        numbers = (self.pseudorange_m, self.phase_cyc, self.doppler_hz, self.gnss, self.sv, self.sig, self.freq, self.lock_ms, self.cn0)
        return struct.pack("<ddfBBBBHBBBBBx", *numbers, self.code_sigma, self.phase_sigma, 0, self.track)


def rawx(*rows: Row, tow_s: float = 1000.0, week: int = 2350, status: int = 1, version: int = 1, count: int | None = None) -> Frame:
    header = struct.pack("<dHbBBBxx", tow_s, week, 18, len(rows) if count is None else count, status, version)
    return frame(RAWX, header + b"".join(row.pack() for row in rows))


def epoch_of(messages: list[Message]) -> Epoch:
    (epoch,) = messages
    assert isinstance(epoch, Epoch)
    return epoch


def test_a_measurement_becomes_a_row_with_all_its_values():
    """Values, units, accuracies and the lock time of one signal."""
    epoch = epoch_of(UbxDecoder().decode(rawx(Row(), tow_s=302_399.9985)))
    assert epoch.time == GpsTime(2350, 302_399.9985)
    assert list(epoch.rows()) == [("G05", "1C", 2.2e7, 1.1e8, -1234.5, 44.0)]
    assert epoch.lock_s[0] == 5.0
    assert epoch.pseudorange_sigma_m[0] == pytest.approx(0.32)
    assert epoch.phase_sigma_cyc[0] == pytest.approx(0.008)
    assert epoch.channel[0] == NO_CHANNEL


SIGNALS = [
    (0, 3, 0, "G03", "1C"), (0, 3, 3, "G03", "2L"), (0, 3, 4, "G03", "2S"), (0, 3, 6, "G03", "5I"), (0, 3, 7, "G03", "5Q"),
    (1, 123, 0, "S23", "1C"), (2, 36, 0, "E36", "1C"), (2, 36, 1, "E36", "1B"), (2, 36, 3, "E36", "5I"), (2, 36, 4, "E36", "5Q"),
    (2, 36, 5, "E36", "7I"), (2, 36, 6, "E36", "7Q"), (3, 63, 0, "C63", "2I"), (3, 1, 1, "C01", "2I"), (3, 5, 2, "C05", "7I"),
    (3, 5, 3, "C05", "7I"), (3, 5, 4, "C05", "6I"), (3, 5, 10, "C05", "6I"), (3, 20, 5, "C20", "1P"), (3, 20, 6, "C20", "1D"),
    (3, 20, 7, "C20", "5P"), (3, 20, 8, "C20", "5D"), (5, 2, 0, "J02", "1C"), (5, 2, 1, "J02", "1Z"), (5, 2, 4, "J02", "2S"),
    (5, 2, 5, "J02", "2L"), (5, 2, 8, "J02", "5I"), (5, 2, 9, "J02", "5Q"), (6, 24, 0, "R24", "1C"), (6, 24, 2, "R24", "2C"),
    (7, 9, 0, "I09", "5A"),
]  # fmt: skip


@pytest.mark.parametrize(("gnss", "sv", "sig", "satellite", "code"), SIGNALS)
def test_vendor_ids_become_rinex_ids(gnss: int, sv: int, sig: int, satellite: str, code: str):
    """Each pair of gnssId and sigId that u-blox documents."""
    epoch = epoch_of(UbxDecoder().decode(rawx(Row(gnss=gnss, sv=sv, sig=sig))))
    assert [row[:2] for row in epoch.rows()] == [(satellite, code)]


def test_rows_are_sorted_and_unknown_or_repeated_signals_are_counted():
    """Order of arrival does not matter; a GLONASS satellite without a slot (255) and a second copy are dropped."""
    rows = [
        Row(gnss=6, sv=9, sig=2),
        Row(gnss=6, sv=255),
        Row(sv=7),
        Row(sv=5, sig=3),
        Row(sv=5),
        Row(sv=7, pseudorange_m=1.0),
        Row(gnss=4, sv=1),
    ]
    decoder = UbxDecoder()
    epoch = epoch_of(decoder.decode(rawx(*rows)))
    assert [row[:3] for row in epoch.rows()] == [
        ("G05", "1C", 2.2e7), ("G05", "2L", 2.2e7), ("G07", "1C", 2.2e7), ("R09", "2C", 2.2e7)
    ]  # fmt: skip
    assert decoder.counters.rejected["ubx/02-15 unknown signal"] == 3


def test_validity_bits_blank_what_is_not_valid():
    """Code and phase have their own bits; the half cycle flag stands only beside a phase; index 15 is no accuracy."""
    rows = [
        Row(sv=1, track=PHASE | HALF_KNOWN), Row(sv=2, track=PSEUDORANGE), Row(sv=3, track=PSEUDORANGE | PHASE),
        Row(sv=4, phase_sigma=15), Row(sv=5, pseudorange_m=float("nan"), phase_cyc=float("inf"), doppler_hz=float("nan")),
    ]  # fmt: skip
    epoch = epoch_of(UbxDecoder().decode(rawx(*rows)))
    assert np.isnan(epoch.pseudorange_m).tolist() == [True, False, False, False, True]
    assert np.isnan(epoch.phase_cyc).tolist() == [False, True, False, False, True]
    assert np.isnan(epoch.doppler_hz).tolist() == [False, False, False, False, True]
    assert (epoch.flags & HALF_CYCLE).tolist() == [0, 0, HALF_CYCLE, 0, 0]
    assert np.isnan(epoch.phase_sigma_cyc).tolist() == [False, False, False, True, False]


def test_glonass_channels_come_from_the_frequency_id():
    """freqId counts from 0 for channel -7."""
    rows = [Row(gnss=6, sv=1, freq=0), Row(gnss=6, sv=2, freq=13), Row(gnss=6, sv=3, freq=255)]
    assert epoch_of(UbxDecoder().decode(rawx(*rows))).channel.tolist() == [-7, 6, NO_CHANNEL]


def test_the_old_version_has_no_signal_id():
    """RXM-RAWX version 0: the byte is reserved and must not be read."""
    epoch = epoch_of(UbxDecoder().decode(rawx(Row(sig=7), version=0)))
    assert [row[:2] for row in epoch.rows()] == [("G05", "1C")]


@pytest.mark.parametrize(
    ("second", "seconds", "slipped"),
    [
        (Row(lock_ms=6000), 1.0, False),
        (Row(lock_ms=4999), 1.0, True),  # it fell
        (Row(lock_ms=0), 1.0, True),
        (Row(lock_ms=6000, track=GOOD | HALF_SUBTRACTED), 1.0, True),  # the phase was turned by half a cycle
        (Row(lock_ms=7000), 30.0, True),  # it grew, but not by the time that passed
        (Row(lock_ms=64500), 100.0, False),  # it counts no further
    ],
)
def test_slips_show_in_the_lock_time(second: Row, seconds: float, slipped: bool):
    """The second of two epochs of one signal."""
    decoder = UbxDecoder()
    assert epoch_of(decoder.decode(rawx(Row(lock_ms=5000)))).flags[0] & SLIP == 0
    assert bool(epoch_of(decoder.decode(rawx(second, tow_s=1000.0 + seconds))).flags[0] & SLIP) is slipped


def test_a_slip_waits_for_the_next_valid_phase():
    """A slip that is seen while the phase is not valid is told with the phase that comes next, once."""
    decoder = UbxDecoder()
    rows = [Row(lock_ms=5000), Row(lock_ms=100, track=PSEUDORANGE), Row(lock_ms=1100), Row(lock_ms=2100)]
    flags = [int(epoch_of(decoder.decode(rawx(row, tow_s=1000.0 + i))).flags[0]) & SLIP for i, row in enumerate(rows)]
    assert flags == [0, 0, SLIP, 0]


def test_clock_resets_are_counted():
    """recStat bit 1."""
    decoder = UbxDecoder()
    decoder.decode(rawx(status=3))
    decoder.decode(rawx(status=1, tow_s=1001.0))
    assert (decoder.clock_resets, decoder.counters.epochs) == (1, 2)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (rawx(Row(), count=2), "length"),
        (frame(RAWX, b"\0" * 15), "length"),
        (rawx(Row(), week=0), "time"),
        (rawx(Row(), tow_s=float("nan")), "time"),
        (rawx(Row(), tow_s=1e300), "time"),
        (frame(SFRBX, b"\0\x05\0\0\x0a\0\x02\0" + b"\0" * 39), "length"),
        (frame(SFRBX, b"\0\x05"), "length"),
        (frame(SFRBX, b"\0\x05\0\0\x0a\0\x02\0" + b"\0" * 40), "preamble"),
        (frame(SFRBX, b"\x06\xff\0\0\x04\0\x02\0" + b"\0" * 16), "satellite"),
        (frame(NAV_PVT, b"\0" * 40), "length"),
    ],
)
def test_damaged_payloads_are_rejected_with_their_reason(message: Frame, reason: str):
    """Counts from the wire are held against the bytes there are; nothing raises."""
    decoder = UbxDecoder()
    assert decoder.decode(message) == []
    assert decoder.counters.rejected == {f"ubx/{message.kind} {reason}": 1}


@given(kind=st.sampled_from([RAWX, SFRBX, NAV_PVT]), payload=st.binary(max_size=200), gnss=st.integers(0, 8))
@settings(max_examples=150, deadline=None)
def test_random_payloads_never_raise(kind: str, payload: bytes, gnss: int):
    """Whatever passes the checksum."""
    decoder = UbxDecoder(GpsTime(2350, 0.0))
    decoder.decode(frame(kind, payload))
    decoder.decode(frame(kind, bytes([gnss]) + payload[1:]))
    decoder.decode(frame(RAWX, struct.pack("<dHbBBBxx", 1.0, 2350, 18, len(payload) // 32, 0, 1) + payload))


def subframe_frames() -> list[Frame]:
    """Return navigation blocks of four systems, twice, with messages between them that are refused or of no use."""
    ephemerides = [broadcast(satellite, SENT) for satellite in SATELLITES[::6]]
    good = [part for _ in range(2) for ephemeris in ephemerides for part in encode_ephemeris(ephemeris, SENT)]
    others = [
        frame(SFRBX, b"\x06\xff\0\0\x04\0\x02\0" + b"\0" * 16),
        frame(SFRBX, b"\0\x05\0\0\x0a\0\x02\0" + b"\0" * 40),
        frame(SFRBX, b"\0\x05"),
        frame(SFRBX, b"\x01\x7b\0\0\x09\0\x02\0" + b"\0" * 36),
    ]
    return [part for k, data in enumerate(good) for part in (Frame(Protocol.UBX, SFRBX, data), *others[k % 9 : k % 9 + 1])]


@given(cuts=st.lists(st.integers(0, 400), max_size=12), timed=st.booleans())
@settings(max_examples=30, deadline=None)
def test_navigation_blocks_may_be_decoded_in_runs_of_any_length(cuts: list[int], timed: bool):
    """Runs give what the frames give one by one: the messages of each frame, and the counters."""
    frames = subframe_frames()
    single, runs = UbxDecoder(SENT if timed else None), UbxDecoder(SENT if timed else None)
    expected = [single.decode(part) for part in frames]
    edges = [0, *sorted(min(cut, len(frames)) for cut in cuts), len(frames)]
    assert [found for start, end in pairwise(edges) for found in runs.decode_subframes(frames[start:end])] == expected
    assert (runs.counters, runs.time) == (single.counters, single.time)
    assert sum(len(found) for found in expected) > 10
    assert single.counters.rejected.keys() == {f"ubx/02-13 {reason}" for reason in ("satellite", "preamble", "length")}


@pytest.mark.parametrize(
    ("satellite", "offset", "value", "found"),
    [
        ("R07", 2, 2, True), ("R07", 2, 200, True), ("R07", 3, 20, True), ("R07", 3, 21, False), ("R07", 4, 3, False),
        ("G05", 3, 99, True), ("G05", 2, 3, False), ("G05", 2, 200, False), ("G05", 4, 9, False), ("E11", 2, 5, True), ("E11", 2, 3, False),
        ("E11", 4, 8, True), ("E11", 4, 7, False), ("C21", 2, 2, True), ("C21", 2, 1, False),
    ],
)  # fmt: skip
def test_only_signals_with_ephemerides_of_ours_are_read(satellite: str, offset: int, value: int, found: bool):
    """sigId (2), freqId (3) and number of words (4) of all messages of one satellite changed to a value."""
    messages = [bytearray(data) for data in encode_ephemeris(broadcast(satellite_number(satellite), SENT), SENT)]
    decoder = UbxDecoder(SENT)
    for message in messages:
        message[6 + offset] = value
    given = [one for message in messages for one in decoder.decode(Frame(Protocol.UBX, SFRBX, bytes(message)))]
    assert any(isinstance(one, KeplerEphemeris | GlonassEphemeris) for one in given) == found
    assert not decoder.counters.rejected


def test_a_run_that_is_cut_short_is_refused_where_it_ends():
    """Nothing is read behind the bytes there are."""
    whole = subframe_frames()[0]
    decoder = UbxDecoder(SENT)
    for length in range(1, len(whole.data)):
        assert decoder.decode_subframes([whole, whole._replace(data=whole.data[:length])])[1] == []
    assert decoder.counters.rejected == {"ubx/02-13 length": len(whole.data) - 1}


def test_messages_of_no_use_here_are_counted_as_ignored():
    """They are the services' to read."""
    decoder = UbxDecoder()
    assert decoder.decode(frame("01-22", b"")) == []
    assert decoder.counters.ignored == {"ubx/01-22": 1}


def nav_pvt(valid: int = 7, fix_type: int = 3, flags: int = 1, date: tuple[int, ...] = (2025, 1, 20), tow_ms: int = 132_618_000) -> Frame:
    head = struct.pack("<IHBBBBBBIi", tow_ms, *date, 12, 50, 0, valid, 25, -300_000)
    state = struct.pack("<BBBBiiii", fix_type, flags, 0, 17, 135_000_000, 523_000_000, 123_456, 80_000)
    accuracy = struct.pack("<IIiii", 14, 21, 1000, -2000, 30)
    return frame(NAV_PVT, (head + state + accuracy).ljust(92, b"\0"))


@pytest.mark.parametrize(
    ("fix_type", "flags", "fix"),
    [(0, 1, 0), (1, 1, 1), (2, 1, 2), (3, 1, 3), (4, 1, 3), (5, 1, 0), (3, 3, 4), (3, 3 | 1 << 6, 5), (3, 3 | 2 << 6, 6), (3, 2 << 6, 0)],
)
def test_nav_pvt_becomes_the_receivers_fix(fix_type: int, flags: int, fix: int):
    """Kind of fix, position, accuracy, velocity."""
    (message,) = UbxDecoder().decode(nav_pvt(fix_type=fix_type, flags=flags))
    assert isinstance(message, ReceiverFix)
    assert (message.fix, message.satellites, message.time) == (fix, 17, GpsTime(2350, 132_618.0))
    assert (message.lat_rad, message.lon_rad) == (pytest.approx(radians(52.3)), pytest.approx(radians(13.5)))
    assert (message.height_m, message.horizontal_sigma_m, message.vertical_sigma_m) == (123.456, 0.014, 0.021)
    assert message.velocity_ned_mps == (1.0, -2.0, 0.03)


@pytest.mark.parametrize(("valid", "date"), [(0, (2025, 1, 20)), (2, (2025, 1, 20)), (7, (2025, 13, 20)), (7, (0, 0, 0))])
def test_nav_pvt_without_a_valid_date_has_no_time(valid: int, date: tuple[int, ...]):
    """Validity bits and impossible dates."""
    decoder = UbxDecoder()
    (message,) = decoder.decode(nav_pvt(valid=valid, date=date))
    assert isinstance(message, ReceiverFix)
    assert message.time is None
    assert decoder.time is None
