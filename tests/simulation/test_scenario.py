"""Scenarios, their streams and their truth, as the services use them."""

from itertools import islice
from math import pi

import numpy as np
import pytest

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.errors import OptionError
from rtkmesh.gnss.ephemeris import GlonassBias, GlonassEphemeris, KeplerEphemeris, KlobucharParameters, ReceiverFix, ReferenceStation
from rtkmesh.gnss.epoch import HALF_CYCLE, Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.single import SinglePointOptions, single_point
from rtkmesh.simulation.scenario import SCENARIOS, open_stream, truth

START = GpsTime(2445, 529200.0 + 3600.05)
NAMES = [(name, stream) for name, scenario in SCENARIOS.items() for stream in scenario.antennas]


def data(
    scenario: str, stream: str, epochs: int, *, start: GpsTime = START, seed: int = 1, rate_hz: float = 5.0, warm: bool = True
) -> list[bytes]:
    opened = open_stream(scenario, stream, seed=seed, rate_hz=rate_hz, start=start, warm=warm)
    return [epoch.data for epoch in islice(opened.epochs(), epochs)]


def decoded(chunks: list[bytes], start: GpsTime = START) -> list[Message]:
    decoder = StreamDecoder(StreamOptions(approximate_time=start))
    return [message for chunk in chunks for _, messages in decoder.feed(chunk) for message in messages] + decoder.flush()


def observed(scenario: str, stream: str, epochs: int, start: GpsTime = START) -> list[Epoch]:
    simulated = open_stream(scenario, stream, seed=1, rate_hz=5.0, start=start)
    receiver = simulated.receiver()
    return [receiver.observe(tag).epoch for tag in islice(simulated.tags(), epochs)]


def columns_agree(found: Epoch, sent: Epoch, *, code_m: float, phase_cyc: float, doppler_hz: float, cn0_db: float) -> None:
    assert np.array_equal(found.satellite, sent.satellite)
    assert np.array_equal(found.signal, sent.signal)
    assert np.array_equal(found.channel, sent.channel)
    assert np.array_equal(found.flags & HALF_CYCLE, sent.flags & HALF_CYCLE)
    for name, tolerance in (("pseudorange_m", code_m), ("phase_cyc", phase_cyc), ("doppler_hz", doppler_hz), ("cn0_dbhz", cn0_db)):
        assert np.abs(getattr(found, name) - getattr(sent, name)).max() <= tolerance, name


@pytest.mark.parametrize(("scenario", "stream"), NAMES)
def test_same_seed_gives_the_same_bytes_and_another_seed_others(scenario: str, stream: str):
    """Every stream of every scenario is deterministic."""
    first, again, other = (data(scenario, stream, 4, seed=seed) for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_a_rover_sends_what_it_observed():
    """UBX: every epoch comes back; codes, phases and Dopplers exactly, C/N0 in whole dB; the fix of the receiver is near."""
    messages, sent = decoded(data("demo", "rover", 15)), observed("demo", "rover", 15)
    epochs = [m for m in messages if isinstance(m, Epoch)]
    assert [e.time for e in epochs] == [e.time for e in sent]
    for found, was in zip(epochs, sent, strict=True):
        columns_agree(found, was, code_m=0.0, phase_cyc=0.0, doppler_hz=1e-3, cn0_db=0.5)
    fixes = [m for m in messages if isinstance(m, ReceiverFix)]
    assert len(fixes) == 15
    assert all(abs(np.rad2deg(fix.lat_rad) - 52.5) < 0.01 and fix.fix == 3 for fix in fixes)


def test_a_base_sends_what_it_observed():
    """RTCM 3 MSM7: every epoch comes back within the resolution of the message, with the place of the antenna."""
    messages, sent = decoded(data("demo", "base", 15)), observed("demo", "base", 15)
    epochs = [m for m in messages if isinstance(m, Epoch)]
    assert [e.time for e in epochs] == [GpsTime(e.time.week, round(e.time.tow_s * 1e3) * 1e-3) for e in sent]
    for found, was in zip(epochs, sent, strict=True):
        columns_agree(found, was, code_m=6e-4, phase_cyc=1e-3, doppler_hz=3e-3, cn0_db=0.04)
    station = next(m for m in messages if isinstance(m, ReferenceStation) and m.position_ecef_m)
    place = truth("demo", seed=1)(START).antennas_ecef_m["base"]
    assert station.position_ecef_m == pytest.approx(place.tolist(), abs=6e-5)
    assert any(isinstance(m, GlonassBias) for m in messages)


@pytest.mark.parametrize("stream", ["rover", "base"])
def test_a_warm_stream_hands_out_all_ephemerides_within_two_seconds(stream: str):
    """What is in view can be used at once, by its own ephemeris, from UBX subframes as from RTCM messages."""
    messages = decoded(data("demo", stream, 12))
    epochs = [m for m in messages if isinstance(m, Epoch)]
    sent = {m.satellite for m in messages if isinstance(m, KeplerEphemeris | GlonassEphemeris)}
    assert sent == {int(s) for epoch in epochs for s in epoch.satellite}
    assert any(isinstance(m, KlobucharParameters) for m in messages) == (stream == "rover")


def test_a_cold_stream_hands_them_out_within_a_frame():
    """Half a minute after acquisition everything is there, at the start nothing."""
    chunks = data("demo", "rover", 40, rate_hz=1.0, warm=False)
    early, all_ = decoded(chunks[:18]), decoded(chunks)
    assert not [m for m in early if isinstance(m, KeplerEphemeris | GlonassEphemeris)]
    sent = {m.satellite for m in all_ if isinstance(m, KeplerEphemeris | GlonassEphemeris)}
    last = [m for m in all_ if isinstance(m, Epoch)][-1]
    assert sent >= set(last.satellite[last.lock_s > 31.0].tolist())
    assert len(sent) > 25


def test_positions_and_velocities_are_found_by_broadcast_ephemerides():
    """Single-point positioning of the rover, fed with its own bytes, is within metres and decimetres per second of the truth."""
    simulated = open_stream("demo", "rover", seed=1, rate_hz=5.0, start=START)
    table, decoder, at = EphemerisTable(), StreamDecoder(StreamOptions(approximate_time=START)), truth("demo", seed=1)
    klobuchar, errors, speeds = None, list[float](), list[float]()
    for sent in islice(simulated.epochs(), 30):
        messages = [m for _, found in decoder.feed(sent.data) for m in found]
        for message in messages:
            if isinstance(message, KeplerEphemeris | GlonassEphemeris):
                table.add(message)
            elif isinstance(message, KlobucharParameters) and message.system == "G":
                klobuchar = message
        epoch = next(m for m in messages if isinstance(m, Epoch))
        solved, now = single_point(epoch, table, SinglePointOptions(klobuchar=klobuchar)), at(sent.time)
        if solved.ok:
            errors.append(float(np.linalg.norm(solved.position_ecef_m - now.antennas_ecef_m["rover"])))
            speeds.append(float(np.linalg.norm(solved.velocity_ecef_mps - now.velocities_ecef_mps["rover"])))
    assert len(errors) > 20
    assert np.median(errors) < 2.5
    assert max(errors[10:]) < 5.0
    assert np.median(speeds) < 0.1


def test_truth_tells_the_attitude_that_the_antennas_show():
    """The vector from the rover's antenna to the heading antenna is 1 m long and points to the heading."""
    at = truth("demo", seed=4)
    for k in range(0, 300, 30):
        now = at(START + float(k))
        baseline = now.antennas_ecef_m["heading"] - now.antennas_ecef_m["rover"]
        east, north, up = SCENARIOS["demo"].site.ecef_from_enu().T @ baseline
        assert np.linalg.norm(baseline) == pytest.approx(1.0, abs=1e-8)
        assert (np.arctan2(east, north) - now.heading_rad + pi) % (2 * pi) - pi == pytest.approx(0.0, abs=1e-9)
        assert np.arcsin(up) == pytest.approx(now.pitch_rad, abs=1e-8)


def test_a_stream_that_starts_later_agrees_on_everything_but_its_ambiguities():
    """A receiver that is started again sees the same satellites from the same place with the same clock."""
    early = observed("demo", "rover", 26)[-1]
    late = observed("demo", "rover", 1, START + 5.0)[0]
    assert early.time == late.time
    _, i, j = np.intersect1d(early.satellite * 512 + early.signal, late.satellite * 512 + late.signal, return_indices=True)
    assert len(i) > 50
    difference = early.pseudorange_m[i] - late.pseudorange_m[j]
    assert np.abs(difference).max() < 12.0
    assert abs(np.mean(difference)) < 0.5
    assert np.array_equal(np.sign(early.doppler_hz[i]), np.sign(late.doppler_hz[j]))


def test_epochs_fall_on_multiples_of_the_interval_over_the_end_of_the_week():
    """5 Hz from shortly before the rollover: no gap, no repetition, no 604800."""
    tags = list(islice(open_stream("demo", "base", seed=1, rate_hz=5.0, start=GpsTime(2445, 604799.45)).tags(), 6))
    expected = [(2445, 604799.6), (2445, 604799.8), (2446, 0.0), (2446, 0.2), (2446, 0.4), (2446, 0.6)]
    assert [(t.week, t.tow_s) for t in tags] == [(week, pytest.approx(tow_s, abs=1e-9)) for week, tow_s in expected]


def test_streams_go_on_over_the_end_of_the_week():
    """Rover and base, decoded, have every epoch around the rollover and unbroken ephemerides."""
    start = GpsTime(2445, 604799.0)
    for stream in ("rover", "base"):
        epochs = [m for m in decoded(data("demo", stream, 12, start=start), start) if isinstance(m, Epoch)]
        assert [round((e.time - start) * 5) for e in epochs] == list(range(12))
        assert min(map(len, epochs)) > 40


@pytest.mark.parametrize(
    ("scenario", "stream", "rate_hz", "word"),
    [
        ("demo", "antenna9", 5.0, "heading"),
        ("nowhere", "rover", 5.0, "demo"),
        ("demo", "rover", 0.0, "rate"),
        ("demo", "rover", 7.0, "rate"),
    ],
)
def test_wrong_names_and_rates_are_refused_with_the_right_ones(scenario: str, stream: str, rate_hz: float, word: str):
    """The caller is told what there is."""
    with pytest.raises(OptionError, match=word):
        open_stream(scenario, stream, seed=1, rate_hz=rate_hz, start=START)
