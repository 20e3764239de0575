"""The stream decoder: one rising timeline of epochs, each piece of navigation data once, whatever the cuts and the damage."""

import struct
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.checksums import fletcher16
from rtkmesh.codecs.messages import Message, Protocol
from rtkmesh.codecs.stream import ObservationSource, StreamDecoder, StreamOptions, Timeline
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, ReceiverFix
from rtkmesh.gnss.epoch import SLIP, Epoch, make_epoch
from rtkmesh.gnss.time import GpsTime


def rawx(week: int, tow_s: float, satellites: int = 3) -> bytes:
    rows = b"".join(struct.pack("<ddfBBBBHBBBBBx", 2.2e7, 1.1e8, 1.0, 0, 1 + i, 0, 0, 5000, 40, 5, 2, 0, 7) for i in range(satellites))
    body = b"\x02\x15" + struct.pack("<H", 16 + len(rows)) + struct.pack("<dHbBBBxx", tow_s, week, 18, satellites, 1, 1) + rows
    return b"\xb5\x62" + body + fletcher16(np.frombuffer(body, np.uint8)).to_bytes(2, "little")


def messages_of(decoder: StreamDecoder, data: bytes) -> list[Message]:
    return [message for _, found in decoder.feed(data) for message in found] + decoder.flush()


def times(messages: list[Message]) -> list[float]:
    return [m.time.week * 604_800 + m.time.tow_s for m in messages if isinstance(m, Epoch)]


def same(a: Message, b: Message) -> bool:
    if isinstance(a, Epoch) and isinstance(b, Epoch):
        return a.time == b.time and all(
            np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=f.name.endswith(("_m", "_cyc", "_hz", "_s", "hz")))
            for f in fields(Epoch)
            if f.name != "time"
        )
    return repr(a) == repr(b)


def test_an_overtaken_epoch_is_passed_on_late_once():
    """Networks let epochs overtake each other; pairing puts them in their places."""
    decoder = StreamDecoder()
    found = messages_of(decoder, b"".join(rawx(2350, t) for t in (100.0, 101.0, 100.5, 100.5, 102.0)))
    assert times(found) == [2350 * 604_800 + t for t in (100.0, 101.0, 100.5, 102.0)]


@pytest.mark.parametrize(
    ("accept", "reject", "epochs"),
    [((), (), 2), (("ubx/02-15",), (), 2), (("rtcm3/1077",), (), 0), ((), ("ubx/02-15",), 0), (("ubx/02-15",), ("ubx/02-15",), 0)],
)
def test_frames_that_are_not_wanted_are_counted_and_not_decoded(accept: tuple[str, ...], reject: tuple[str, ...], epochs: int):
    decoder = StreamDecoder(StreamOptions(accept=frozenset(accept), reject=frozenset(reject)))
    frames = decoder.feed(rawx(2350, 100.0) + rawx(2350, 101.0))
    assert len(frames) == 2
    assert sum(isinstance(m, Epoch) for _, found in frames for m in found) == epochs
    assert decoder.decoding.ignored.total() == 2 - epochs
    assert decoder.framing.frames.total() == 2


def test_repeated_and_late_epochs_are_dropped_and_counted():
    """An epoch that comes twice, or long after a newer one, is no epoch."""
    decoder = StreamDecoder()
    found = messages_of(decoder, b"".join(rawx(2350, t) for t in (100.0, 110.0, 110.0, 104.5, 112.0)))
    assert times(found) == [2350 * 604_800 + t for t in (100.0, 110.0, 112.0)]
    assert decoder.decoding.rejected == {"ubx epoch repeated": 1, "ubx epoch out of order": 1}
    assert decoder.decoding.epochs == 3


def test_a_clock_that_was_set_back_is_followed_after_some_epochs():
    """A receiver may correct a wrong first date: the stream must not stay silent for ever."""
    data = b"".join(rawx(2400, 100.0 + i) for i in range(3)) + b"".join(rawx(2350, 100.0 + i) for i in range(8))
    found = times(messages_of(StreamDecoder(), data))
    assert found == [2400 * 604_800 + 100.0 + i for i in range(3)] + [2350 * 604_800 + 104.0 + i for i in range(4)]


def test_a_sentence_that_is_named_like_a_number_of_ubx_is_a_sentence():
    """`$02-13` is a whole NMEA frame whose kind reads as that of RXM-SFRBX; among subframes of UBX it is still none of them."""
    body = b"\x02\x13\x08\x00" + bytes(8)
    subframe = b"\xb5\x62" + body + fletcher16(np.frombuffer(body, np.uint8)).to_bytes(2, "little")
    text = b"02-13,1"
    sentence = b"$%b*%02X\r\n" % (text, np.bitwise_xor.reduce(np.frombuffer(text, np.uint8)))
    decoder = StreamDecoder()
    found = decoder.feed(subframe + sentence + subframe)
    assert [frame.protocol for frame, _ in found] == [Protocol.UBX, Protocol.NMEA, Protocol.UBX]
    assert decoder.decoding.ignored["nmea/02-13"] == 1
    assert sum(count for name, count in (decoder.decoding.decoded + decoder.decoding.rejected).items() if name.startswith("ubx/02-13")) == 2


def epoch_at(time: GpsTime) -> Epoch:
    return make_epoch(time, satellite=[1], signal=[28], phase_cyc=[1.0])


def passed(timeline: Timeline, arrivals: list[tuple[float, Protocol]]) -> list[tuple[float, Protocol]]:
    out: list[tuple[float, Protocol]] = []
    for tow_s, protocol in arrivals:
        timeline.switches(protocol)
        if not timeline.refusal(epoch_at(GpsTime(2350, tow_s)), protocol):
            out.append((tow_s, protocol))
    return out


BOTH = [(100.0 + i + dt, protocol) for i in range(50) for dt, protocol in ((-0.009, Protocol.UBX), (0.0, Protocol.RTCM3))]


@pytest.mark.parametrize(("source", "protocol"), [("auto", Protocol.UBX), ("ubx", Protocol.UBX), ("rtcm3", Protocol.RTCM3)])
def test_the_same_epoch_in_two_protocols_comes_once(source: str, protocol: Protocol):
    """A base that logs what it sends: the first protocol seen, or the one chosen, is used alone."""
    assert passed(Timeline(ObservationSource(source)), BOTH) == [arrival for arrival in BOTH if arrival[1] is protocol]


def test_raw_protocols_are_preferred_to_rtcm():
    """Unicore, SBF or NovAtel are taken after three epochs, two raw protocols change only when one is gone."""
    for raw in (Protocol.UNICORE, Protocol.SBF, Protocol.NOVATEL):
        found = passed(Timeline(ObservationSource.AUTO), [(t, raw if p is Protocol.UBX else p) for t, p in BOTH[1:]])
        assert [p for _, p in found] == [Protocol.RTCM3, Protocol.RTCM3, Protocol.RTCM3, *[raw] * 47]
    two = [(t, Protocol.UNICORE if p is Protocol.RTCM3 else p) for t, p in BOTH]
    assert passed(Timeline(ObservationSource.AUTO), two) == [arrival for arrival in two if arrival[1] is Protocol.UBX]


def test_the_protocol_that_delivers_more_takes_over():
    """If the chosen protocol dies or is damaged, the other one is taken once it is 30 epochs ahead."""
    arrivals = [*BOTH[:20], *((200.0 + i, Protocol.RTCM3) for i in range(60))]
    found = passed(Timeline(ObservationSource.AUTO), arrivals)
    assert [a for a in found if a[1] is Protocol.UBX] == [a for a in BOTH[:20] if a[1] is Protocol.UBX]
    assert [a for a in found if a[1] is Protocol.RTCM3] == [(200.0 + i, Protocol.RTCM3) for i in range(28, 60)]


@pytest.mark.data
def test_the_first_epoch_after_a_change_of_protocol_is_all_slips(data: Path):
    """Phases of the two protocols differ by integers: a filter must not carry ambiguities over."""
    log = (data / "umea_f9p" / "R001.ubx").read_bytes()
    corrections = (data / "stromlo_rtcm" / "week-rollover-STR24.rtcm3").read_bytes()[:60_000]
    decoder = StreamDecoder(StreamOptions(approximate_time=GpsTime(2009, 600_000.0)))
    first = messages_of(decoder, corrections)
    count = len(times(first))
    assert count > 30
    epochs = [m for m in messages_of(decoder, log) if isinstance(m, Epoch)]
    assert len(epochs) == 408 - 2  # three epochs make it sure that UBX is there
    phases = np.isfinite(epochs[0].phase_cyc)
    assert phases.any()
    assert (epochs[0].flags[phases] & SLIP).all()
    assert not (epochs[5].flags & SLIP).all()


@pytest.mark.data
@given(cuts=st.lists(st.integers(0, 60_000), max_size=8))
@settings(max_examples=6, deadline=None)
def test_any_cut_of_a_recording_gives_the_same_messages(data: Path, cuts: list[int]):
    """A mixed, damaged log of a base: messages and counters do not depend on how it is cut."""
    log = (data / "dec_gpsd" / "ublox-zed-f9r.log").read_bytes()[:60_000]
    whole, cut = StreamDecoder(), StreamDecoder()
    expected = messages_of(whole, log)
    edges = [0, *sorted(cuts), len(log)]
    found = [m for start, end in pairwise(edges) for _, some in cut.feed(log[start:end]) for m in some] + cut.flush()
    assert len(expected) > 30
    assert len(found) == len(expected)
    assert all(same(a, b) for a, b in zip(found, expected, strict=True))
    assert (cut.framing, cut.decoding) == (whole.framing, whole.decoding)


@pytest.mark.data
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_damage_never_raises_and_invents_no_epoch(data: Path, seed: int):
    """Flipped bits, lost and doubled pieces in a recording: only epochs that were there come out, in rising order."""
    clean = (data / "dec_ubx" / "gnss_imu_walk_1730.ubx").read_bytes()[:150_000]
    rng = np.random.default_rng(seed)
    damaged = bytearray(clean)
    for position in rng.integers(0, len(damaged), 30):
        damaged[position] ^= 1 << int(rng.integers(8))
    start, length = int(rng.integers(0, len(damaged) - 5000)), int(rng.integers(1, 5000))
    if rng.integers(2):
        del damaged[start : start + length]
    else:
        damaged[start:start] = damaged[start : start + length]
    decoder = StreamDecoder()
    found = times(messages_of(decoder, bytes(damaged)))
    expected = times(messages_of(StreamDecoder(), clean))
    assert set(found) <= set(expected)
    assert all(a < b for a, b in pairwise(found))
    assert len(found) >= len(expected) - 30 - 4  # each flip costs one epoch at most, the lost piece up to four


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "epochs", "ephemerides"),
    [
        ("umea_f9p/B001.ubx", 438, 27),
        ("umea_f9p/R001.ubx", 408, 0),
        ("dec_ubx/gnss_imu_walk_1730.ubx", 536, 19),
        ("dec_gpsd/ublox-zed-f9r.log", 30, 80),
    ],
)
def test_recordings_give_rising_epochs_and_each_ephemeris_once(data: Path, name: str, epochs: int, ephemerides: int):
    """Counts of whole files; no (satellite, message, issue, toe, health) comes twice."""
    found = messages_of(StreamDecoder(), (data / name).read_bytes())
    stamps = times(found)
    assert len(stamps) == epochs
    assert all(a < b for a, b in pairwise(stamps))
    kepler = [(m.satellite, m.message, m.iode, m.iodc, m.toe, m.health) for m in found if isinstance(m, KeplerEphemeris)]
    glonass = [(m.satellite, m.iode, m.toe, m.health) for m in found if isinstance(m, GlonassEphemeris)]
    assert len(kepler) + len(glonass) == ephemerides
    assert len(set(kepler)) == len(kepler)
    assert len(set(glonass)) == len(glonass)


@pytest.mark.data
def test_times_of_ubx_messages_date_the_rtcm_epochs_of_the_stream(data: Path):
    """A log of UBX, NMEA and MSM7: NAV-PVT settles the week, without an approximate time."""
    found = messages_of(StreamDecoder(), (data / "dec_rtcm3" / "pygpsdata-rtcm3.log").read_bytes())
    fixes = [m.time for m in found if isinstance(m, ReceiverFix) and m.time is not None]
    epochs = [m.time for m in found if isinstance(m, Epoch)]
    assert len(epochs) == 158
    assert all(fixes[0] + -5.0 < time for time in epochs)
    assert all(time < fixes[-1] + 5.0 for time in epochs)
