"""The stream of a base station made of any receiver's: slips arrive whatever is left out, budgets hold, station messages always come."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.rtcm3_base import BaseEncoder, BaseOptions, at_whole_milliseconds
from rtkmesh.codecs.rtcm3_thinning import LAST_STEP, ONE_PER_BAND, TWO_BANDS, thinned
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.decimation import Decimator
from rtkmesh.gnss.ephemeris import GlonassBias, KeplerEphemeris, NavigationMessage, ReferenceStation
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.signals import NO_CHANNEL, carrier_hz, satellite_id, satellite_number, signal_code, signal_number
from rtkmesh.gnss.time import GpsTime

START = GpsTime(2400, 345600.0)
STATION = ReferenceStation(3, (3784992.7, 901280.7, 5037095.8), 1.5, "LEIAR25.R3      NONE", "1", "RX")
NO_SHRINK = (Phase.explicit, Phase.reuse, Phase.generate)
ROWS = [
    *((f"G{k:02d}", code) for k in range(1, 9) for code in ("1C", "2L", "2W", "5Q")),
    *((f"R{k:02d}", code) for k in range(1, 5) for code in ("1C", "2C")),
    *((f"E{k:02d}", code) for k in range(1, 6) for code in ("1C", "5Q", "7Q")),
    *((f"C{k:02d}", code) for k in range(20, 25) for code in ("2I", "6I", "7I")),
    ("J02", "1C"), ("J02", "2L"), ("S23", "1C"),
]  # fmt: skip


def epoch_at(time: GpsTime, rows: list[tuple[str, str]] = ROWS, *, slips: frozenset[int] = frozenset(), locks: bool = True) -> Epoch:
    """An epoch whose ranges grow linearly; row numbers in ``slips`` are told as slipped."""
    since_s = time - START
    satellite = np.array([satellite_number(name) for name, _ in rows])
    signal = np.array([signal_number(code) for _, code in rows])
    channel = np.where(satellite // 64 == 1, satellite % 14 - 7, NO_CHANNEL)
    carrier = np.array([carrier_hz(*one) for one in zip(satellite.tolist(), signal.tolist(), channel.tolist(), strict=True)])
    range_m = 2.1e7 + 1e5 * (satellite % 64) + 300.0 * since_s
    flags = np.array([SLIP if k in slips else 0 for k in range(len(rows))])
    return make_epoch(
        time, satellite=satellite, signal=signal, channel=channel, pseudorange_m=range_m, flags=flags,
        phase_cyc=range_m * carrier / SPEED_OF_LIGHT_MPS + 1e6 * (satellite % 7), doppler_hz=-300.0 * carrier / SPEED_OF_LIGHT_MPS,
        cn0_dbhz=np.full(len(rows), 45.0), lock_s=np.full(len(rows), 64.5 if locks else np.nan),
    )  # fmt: skip


def ephemeris_of(name: str, message: NavigationMessage = NavigationMessage.LNAV) -> KeplerEphemeris:
    return KeplerEphemeris(
        satellite=satellite_number(name), message=message, iode=33, iodc=33, toe=START, toc=START, transmitted=START, health=0,
        accuracy_m=2.8, fit_s=7200.0, sqrt_a=5153.7, eccentricity=0.01, m0_rad=1.0, delta_n_radps=4e-9, omega0_rad=2.0, omega_rad=-1.0,
        omega_dot_radps=-8e-9, i0_rad=0.96, idot_radps=1e-10, cuc_rad=1e-6, cus_rad=2e-6, crc_m=100.0, crs_m=-50.0, cic_rad=1e-8,
        cis_rad=-1e-8, af0_s=1e-4, af1=1e-12, af2=0.0, group_delay_s=(-1e-8, 0.0),
    )  # fmt: skip


def decoded(data: bytes) -> list[Message]:
    decoder = StreamDecoder(StreamOptions(approximate_time=START))
    messages = [message for _, found in decoder.feed(data) for message in found] + decoder.flush()
    assert not decoder.decoding.rejected
    assert not decoder.framing.bytes_skipped
    return messages


def epochs_in(data: bytes) -> list[Epoch]:
    return [message for message in decoded(data) if isinstance(message, Epoch)]


def encoded(messages: list[Message], **options: object) -> bytes:
    encoder = BaseEncoder(BaseOptions(**options))  # type: ignore[arg-type]
    return b"".join(frame for message in messages for frame in encoder.take(message))


def numbers(frames: list[bytes]) -> list[int]:
    return [frame[3] << 4 | frame[4] >> 4 for frame in frames]


@given(offset_s=st.floats(-0.49e-3, 0.49e-3))
def test_another_clock_reading_is_the_same_measurement(offset_s: float):
    """The instant of transmission, time minus range over c, stays; phases move as far as ranges; Dopplers stay."""
    epoch = epoch_at(GpsTime(2400, 1000.0 + offset_s))
    moved = at_whole_milliseconds(epoch)
    assert moved.time == GpsTime(2400, 1000.0)
    before, after = (one.time.tow_s - one.pseudorange_m / SPEED_OF_LIGHT_MPS for one in (epoch, moved))
    np.testing.assert_allclose(after, before, rtol=0.0, atol=1.1e-9)  # what is a nanosecond from a millisecond is taken to be there
    carrier = np.array(
        [carrier_hz(*one) for one in zip(epoch.satellite.tolist(), epoch.signal.tolist(), epoch.channel.tolist(), strict=True)]
    )
    step_m = (moved.phase_cyc - epoch.phase_cyc) * SPEED_OF_LIGHT_MPS / carrier
    np.testing.assert_allclose(step_m, moved.pseudorange_m - epoch.pseudorange_m, rtol=0.0, atol=1e-6)
    assert moved.doppler_hz.tolist() == epoch.doppler_hz.tolist()


@settings(max_examples=10, deadline=None, phases=NO_SHRINK)
@given(seed=st.integers(0, 2**32 - 1), interval_s=st.sampled_from((1.0, 2.0, 5.0)), msm=st.sampled_from((4, 5, 7)), locks=st.booleans())
def test_a_slip_is_told_with_the_next_epoch_that_is_sent(seed: int, interval_s: float, msm: int, locks: bool):
    """Exactly the phases that slipped since the last sent epoch are marked, whether the receiver tells lock times or not."""
    rng, rows = np.random.default_rng(seed), [row for row in ROWS if row[0][0] in "GEC"]
    # A stream without lock times begins with zeros, and zero after zero is a slip only in a stream that is known to send others.
    slips = [frozenset(np.flatnonzero(rng.random(len(rows)) < (0.02 if k > interval_s else 0.0)).tolist()) for k in range(31)]
    epochs: list[Message] = [epoch_at(START + float(k), rows, slips=slips[k], locks=locks) for k in range(31)]
    got = epochs_in(encoded(epochs, msm=msm, interval_s=interval_s))
    step = round(interval_s)
    assert [epoch.time for epoch in got] == [START + float(k) for k in range(0, 31, step)]
    order = np.argsort([satellite_number(name) * 512 + signal_number(code) for name, code in rows])
    for k, epoch in enumerate(got):
        since = set[int]().union(*slips[max(0, (k - 1) * step + 1) : k * step + 1])
        assert np.flatnonzero(epoch.flags & SLIP).tolist() == [place for place, row in enumerate(order) if row in since], k


def test_a_phase_that_was_away_without_a_lock_time_is_a_new_one():
    rows = [("G05", "1C"), ("G06", "1C")]
    times = [START + float(k) for k in range(6)]
    epochs: list[Message] = [epoch_at(time, rows if k != 3 else rows[:1], locks=False) for k, time in enumerate(times)]
    got = epochs_in(encoded(epochs))
    assert [epoch.flags.tolist() for epoch in got] == [[0, 0], [0, 0], [0, 0], [0], [0, SLIP], [0, 0]]


def test_half_cycles_and_everything_else_arrive():
    epoch = epoch_at(START)
    epoch = replace(epoch, flags=np.arange(len(epoch)).astype(np.uint8) % 2 * HALF_CYCLE)
    [got] = epochs_in(encoded([epoch]))
    assert got.flags.tolist() == epoch.flags.tolist()
    np.testing.assert_allclose(got.pseudorange_m, epoch.pseudorange_m, atol=3e-4, rtol=0.0)
    whole = got.phase_cyc - epoch.phase_cyc
    np.testing.assert_allclose(whole, np.rint(whole), atol=1e-3)


def test_a_listener_who_comes_back_is_told_of_new_phases_and_of_the_station():
    encoder = BaseEncoder(BaseOptions(station_interval_s=100.0))
    encoder.take(STATION)
    first = numbers(encoder.take(epoch_at(START)))
    assert not {1006, 1033} & set(numbers(encoder.take(epoch_at(START + 1.0))))
    encoder.forget()
    again = encoder.take(epoch_at(START + 50.0))
    assert numbers(again)[:3] == first[:3] == [1006, 1008, 1033]
    assert not (epochs_in(b"".join(again))[0].lock_s > 65.0).any()


def test_the_station_and_biases_come_on_time_with_the_number_of_the_output():
    encoder, seen = BaseEncoder(BaseOptions(station_id=77, station_interval_s=10.0)), Counter[int]()
    encoder.take(STATION)
    encoder.take(GlonassBias(3, True, (1.0, float("nan"), 2.0, float("nan"))))
    for k in range(41):
        frames = encoder.take(epoch_at(START + float(k)))
        assert {int.from_bytes(frame[4:6], "big") & 0xFFF for frame in frames} == {77}
        seen.update(numbers(frames))
    assert [seen[number] for number in (1006, 1008, 1033, 1230)] == [5, 5, 5, 5]
    moved = replace(STATION, position_ecef_m=(3784992.7, 901280.7, 5037096.8))
    encoder.take(moved)
    assert numbers(encoder.take(epoch_at(START + 41.0)))[0] == 1006


def test_ephemerides_are_sent_when_new_and_again_when_it_is_time():
    encoder = BaseEncoder(BaseOptions(systems="GE", ephemeris_interval_s=30.0))
    for name, message in (("G05", NavigationMessage.LNAV), ("E11", NavigationMessage.INAV), ("C23", NavigationMessage.D1)):
        encoder.take(ephemeris_of(name, message))
    few = [row for row in ROWS if row[0] in ("G01", "E01", "R01")]
    seen = [numbers(encoder.take(epoch_at(START + float(k), few))) for k in range(61)]
    at = [k for k, found in enumerate(seen) if {1019, 1046} <= set(found)]
    assert at == [0, 30, 60]
    assert not any({1042, 1087} & set(found) for found in seen)
    encoder.take(ephemeris_of("G05"))  # repeats
    assert 1019 not in numbers(encoder.take(epoch_at(START + 61.0)))


def test_an_ephemeris_that_no_message_can_hold_is_counted():
    encoder = BaseEncoder(BaseOptions())
    ephemeris = ephemeris_of("G05")
    encoder.take(replace(ephemeris, af0_s=1.0))
    assert encoder.flush() == []
    assert encoder.counters["ephemerides_unsendable"] == 1
    encoder.take(ephemeris)
    assert numbers(encoder.flush()) == [1019]


def content(epoch: Epoch) -> set[str]:
    return {satellite_id(s) + signal_code(g) for s, g in zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True)}


def test_steps_take_away_more_and_more():
    epoch = epoch_at(START)
    steps = [content(thinned(epoch, step)) for step in range(LAST_STEP + 1)]
    assert all(more >= less for more, less in pairwise(steps))
    assert steps[0] == content(epoch)
    assert steps[0] - steps[ONE_PER_BAND] == {f"G{k:02d}2W" for k in range(1, 9)}
    assert steps[ONE_PER_BAND] - steps[TWO_BANDS] == {*(f"G{k:02d}5Q" for k in range(1, 9)), *(f"E{k:02d}5Q" for k in range(1, 6)), *(
        f"C{k:02d}6I" for k in range(20, 25)
    )}  # fmt: skip
    assert {name[0] for name in steps[-1]} == {"G", "E", "C"}
    assert len(steps[-1]) == 2 * (8 + 5 + 5)


@settings(max_examples=6, deadline=None, phases=NO_SHRINK)
@given(limit=st.floats(60.0, 1500.0), period_s=st.sampled_from((0.5, 1.0)), msm=st.sampled_from((4, 7)))
def test_a_budget_is_never_exceeded_and_never_wasted(limit: float, period_s: float, msm: int):
    """The mean rate over half a minute stays within the limit; a limit that holds one thinned epoch in ten seconds gives epochs."""
    encoder, sent, times = BaseEncoder(BaseOptions(msm=msm, bytes_per_second=limit, station_interval_s=10.0)), 0, list[float]()
    encoder.take(STATION)
    seen = Counter[int]()
    for k in range(round(30.0 / period_s) + 1):
        frames = encoder.take(epoch_at(START + round(k * period_s, 3)))
        seen.update(numbers(frames))
        sent += sum(map(len, frames))
        if any(number >= 1070 for number in numbers(frames)):
            times.append(k * period_s)
    assert seen[1006] == 4
    station = 4 * 150
    assert sent <= limit * 31.0 + station + 1500
    smallest = sum(map(len, BaseEncoder(BaseOptions(msm=msm)).take(thinned(epoch_at(START), LAST_STEP))))
    rest = limit - 150 / 10.0
    if rest * 10.0 > smallest * 1.1:
        assert len(times) >= 2
        assert max(b - a for a, b in pairwise(times)) <= smallest / rest + 2.0 * period_s + 1e-6
    if rest * period_s > sum(map(len, BaseEncoder(BaseOptions(msm=msm)).take(epoch_at(START)))) * 1.01:
        assert encoder.step == 0
        assert not encoder.counters["epochs_left_out"]


def test_a_link_that_gets_better_gets_its_signals_back():
    """After some calm epochs the steps are taken back one by one."""
    encoder = BaseEncoder(BaseOptions(bytes_per_second=700.0))
    for k in range(20):
        encoder.take(epoch_at(START + float(k)))
    assert encoder.step > 0
    few = [row for row in ROWS if row[0] in ("G01", "G02", "E01", "C20")]
    for k in range(20, 20 + 31 * LAST_STEP):
        encoder.take(epoch_at(START + float(k), few))
    assert encoder.step == 0


def test_without_an_end_of_waiting_ephemerides_the_rest_is_what_the_link_leaves():
    """On a slow link ephemerides come one after the other and the rate holds."""
    encoder = BaseEncoder(BaseOptions(msm=4, bytes_per_second=450.0))
    for k in range(1, 9):
        encoder.take(ephemeris_of(f"G{k:02d}"))
    sizes = [sum(map(len, encoder.take(epoch_at(START + float(k))))) for k in range(60)]
    assert sum(sizes) <= 450.0 * 61.0
    assert encoder.flush() == []


@pytest.mark.parametrize(("interval_s", "step_s", "expected"), [(1.0, 0.1, 11), (0.0, 0.1, 101), (5.0, 1.0, 21), (0.5, 0.2, 21)])
def test_epochs_at_multiples_are_taken_however_the_clock_wanders(interval_s: float, step_s: float, expected: int):
    decimator, rng = Decimator(interval_s), np.random.default_rng(1)
    taken = [k for k in range(101) if decimator.takes(START + (k * step_s + float(rng.uniform(-1e-3, 1e-3))))]
    assert len(taken) == expected
