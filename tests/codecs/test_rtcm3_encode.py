"""RTCM 3 encoding: whatever is encoded decodes to itself within the resolution of its fields."""

from dataclasses import fields, replace
from math import inf

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.checksums import crc24q
from rtkmesh.codecs.messages import Frame, Message, Protocol
from rtkmesh.codecs.observation_rows import Rows
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import PhaseLeveller, encode_epoch, encode_glonass_bias, encode_station, frame
from rtkmesh.codecs.rtcm3_msm import MILLISECOND_M, SIGNAL_OF_BIT, decode_msm, lock_time_s
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh.gnss.signals import GLONASS, NO_CHANNEL, SYSTEMS, carrier_hz, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime

TIME = GpsTime(2400, 345600.2)
NO_SHRINK = (Phase.explicit, Phase.reuse, Phase.generate)  # epochs come from a seed: smaller ones say no more
MOST_SATELLITES = {"G": 63, "R": 27, "E": 36, "C": 63, "J": 10, "S": 39, "I": 14}


def decode(frames: list[bytes], near: GpsTime = TIME) -> list[Message]:
    decoder = Rtcm3Decoder(near)
    messages = [message for data in frames for message in decoder.decode(Frame(Protocol.RTCM3, "", data))]
    assert not [reason for reason in decoder.counters.rejected if "channel" not in reason]
    return messages + decoder.flush()


@st.composite
def epochs(draw: st.DrawFn) -> Epoch:
    """Epochs of any systems, with values that are missing here and there, codes within 140 m of a range, phases within 350 m of a code.

    Phases of a satellite without a code are sent against the first of them, and the field for what is left ends at 1171 m.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows = [
        (system, number, int(signal))
        for system in draw(st.lists(st.sampled_from(range(7)), min_size=1, max_size=7, unique=True))
        for number in rng.choice(MOST_SATELLITES[SYSTEMS[system]], draw(st.integers(1, 8)), replace=False) + (20 if system == 5 else 1)
        for signal in rng.choice(np.unique(SIGNAL_OF_BIT[system][SIGNAL_OF_BIT[system] >= 0]), draw(st.integers(1, 7)))
    ]
    satellite = np.array([system * 64 + number for system, number, _ in rows], np.int16)
    signal = np.array([signal for _, _, signal in rows], np.int16)
    channel = np.where(satellite // 64 == GLONASS, satellite % 14 - 7, NO_CHANNEL)
    carrier = np.array([carrier_hz(*one) for one in zip(satellite, signal, channel, strict=True)])
    range_m = 2e7 + 1e5 * (satellite % 64) + rng.uniform(-140.0, 140.0, len(rows))
    missing = rng.random((4, len(rows))) < draw(st.sampled_from((0.0, 0.3)))
    rate_mps = 100.0 * (satellite % 13 - 6) + rng.uniform(-0.5, 0.5, len(rows))
    return make_epoch(
        TIME, satellite=satellite, signal=signal, channel=channel, flags=rng.choice((0, HALF_CYCLE), len(rows)),
        pseudorange_m=np.where(missing[0], np.nan, range_m),
        phase_cyc=np.where(missing[1], np.nan, (range_m + rng.uniform(-350.0, 350.0, len(rows))) * carrier / SPEED_OF_LIGHT_MPS),
        doppler_hz=np.where(missing[2], np.nan, -rate_mps * carrier / SPEED_OF_LIGHT_MPS),
        cn0_dbhz=np.where(missing[3], np.nan, rng.uniform(10.0, 60.0, len(rows))), lock_s=rng.uniform(0.0, 6.9e4, len(rows)),
    )  # fmt: skip


RESOLUTION_M = {4: (2.0**-24, 2.0**-29), 5: (2.0**-24, 2.0**-29), 6: (2.0**-29, 2.0**-31), 7: (2.0**-29, 2.0**-31)}


@settings(max_examples=25, deadline=None, phases=NO_SHRINK)
@given(epoch=epochs(), msm=st.sampled_from((4, 5, 6, 7)), station_id=st.integers(0, 4095))
def test_an_epoch_comes_back_within_half_a_resolution_step(epoch: Epoch, msm: int, station_id: int):
    """Rows, missing values, flags and values survive MSM4 to MSM7, split over as many messages as 64 cells demand."""
    frames = encode_epoch(epoch, station_id, msm)
    assert all(int.from_bytes(data[4:6], "big") & 0xFFF == station_id for data in frames)
    messages = decode(frames)
    fdma = (epoch.satellite // 64 == GLONASS) & (msm in (4, 6))  # no channel is sent there, so phases are lost
    empty = np.isnan(epoch.pseudorange_m) & (np.isnan(epoch.phase_cyc) | fdma) & (np.isnan(epoch.doppler_hz) | (msm in (4, 6)))
    kept, fdma = epoch.take(~empty), fdma[~empty]
    if not len(kept):
        assert messages == []
        return
    (got,) = messages
    assert isinstance(got, Epoch)
    assert got.time == TIME
    assert got.satellite.tolist() == kept.satellite.tolist()
    assert got.signal.tolist() == kept.signal.tolist()
    assert got.flags.tolist() == kept.flags.tolist()
    code_m, phase_m = (step * MILLISECOND_M / 2.0 + 1e-8 for step in RESOLUTION_M[msm])
    carrier = np.array([carrier_hz(*one) for one in zip(kept.satellite, kept.signal, kept.channel, strict=True)])
    np.testing.assert_allclose(got.pseudorange_m, kept.pseudorange_m, rtol=0.0, atol=code_m)
    expected_m = np.where(fdma, np.nan, kept.phase_cyc / carrier * SPEED_OF_LIGHT_MPS)
    np.testing.assert_allclose(got.phase_cyc / carrier * SPEED_OF_LIGHT_MPS, expected_m, rtol=0.0, atol=phase_m)
    expected_hz = kept.doppler_hz if msm in (5, 7) else np.full(len(kept), np.nan)
    np.testing.assert_allclose(got.doppler_hz, expected_hz, rtol=0.0, atol=0.5e-4 * 9.0)
    np.testing.assert_allclose(got.cn0_dbhz, kept.cn0_dbhz, rtol=0.0, atol=0.5 if msm < 6 else 0.032)
    assert (got.lock_s <= kept.lock_s + 1e-6).all()
    assert (got.lock_s >= (np.minimum(kept.lock_s, 524.0) * 0.5 - 0.016 if msm < 6 else kept.lock_s * 0.96 - 0.001)).all()


def test_many_cells_are_split_and_only_the_last_message_ends_the_epoch():
    """40 satellites of 4 signals need three messages of at most 64 cells; the multiple-message bit is 1, 1, 0."""
    names = [(f"G{k:02d}", code) for k in range(1, 41) for code in ("1C", "2L", "2W", "5Q")]
    range_m = np.full(len(names), 2.2e7)
    epoch = make_epoch(
        TIME, satellite=[satellite_number(n) for n, _ in names], signal=[signal_number(c) for _, c in names], pseudorange_m=range_m
    )
    frames = encode_epoch(epoch, 1)
    assert [data[3 + 6] >> 1 & 1 for data in frames] == [1, 1, 0]
    assert [len(message) for message in decode(frames) if isinstance(message, Epoch)] == [160]


def test_values_outside_their_fields_are_sent_as_invalid():
    """A code 400 m from its satellite's first one and a phase 2 km away do not fit; what fits stays."""
    epoch = make_epoch(
        TIME, satellite=[5, 5], signal=[signal_number("1C"), signal_number("2L")], pseudorange_m=[2.2e7, 2.2e7 + 400.0],
        phase_cyc=[(2.2e7 + 2000.0) * 1575.42e6 / SPEED_OF_LIGHT_MPS, 2.2e7 * 1227.6e6 / SPEED_OF_LIGHT_MPS],
    )  # fmt: skip
    (got,) = decode(encode_epoch(epoch, 1))
    assert isinstance(got, Epoch)
    assert np.isnan(got.pseudorange_m).tolist() == [False, True]
    assert np.isnan(got.phase_cyc).tolist() == [True, False]


def test_a_signal_without_pseudorange_keeps_its_phase():
    epoch = make_epoch(TIME, satellite=[5], signal=[signal_number("1C")], phase_cyc=[1.1e8], lock_s=[3.0])
    (got,) = decode(encode_epoch(epoch, 1))
    assert isinstance(got, Epoch)
    assert abs(got.phase_cyc[0] - 1.1e8) < 1e-3


def test_the_leveller_shifts_phases_by_constant_integers():
    """Phases with ambiguities of millions of cycles become sendable by one integer per arc; a new arc is marked as slipped."""
    leveller, shifts = PhaseLeveller(), list[float]()
    for k in range(5):
        ambiguity = 7_654_321.25 if k < 4 else -123_456.0
        phase = 2.2e7 * 1575.42e6 / SPEED_OF_LIGHT_MPS + ambiguity + 100.0 * k
        epoch = make_epoch(TIME + k, satellite=[5], signal=[signal_number("1C")], pseudorange_m=[2.2e7], phase_cyc=[phase], lock_s=[50.0])
        (got,) = decode(encode_epoch(leveller.level(epoch), 1))
        assert isinstance(got, Epoch)
        shifts.append(round(float(phase - got.phase_cyc[0]), 3))
        assert got.lock_s[0] == (0.0 if k == 4 else 50.0) or k < 4
    assert len(set(shifts[:4])) == 1
    assert all(shift == round(shift) for shift in shifts)
    assert leveller.level(replace(epoch, flags=np.array([SLIP], np.uint8))).lock_s[0] == 50.0


def test_the_frame_is_preamble_length_payload_and_checksum():
    """The CRC-24Q over the whole frame with its checksum is zero; more than 1023 bytes are refused."""
    data = frame(b"\x3e\xd0" + bytes(17))
    assert data[:3] == b"\xd3\x00\x13"
    assert crc24q(np.frombuffer(data, np.uint8)) == 0
    with pytest.raises(ValueError, match="do not fit"):
        frame(bytes(1024))


def test_unknown_message_types_are_refused():
    with pytest.raises(ValueError, match="MSM3"):
        encode_epoch(make_epoch(TIME, satellite=[5], signal=[28]), 1, msm=3)


def test_an_epoch_without_sendable_rows_gives_no_frame():
    assert encode_epoch(make_epoch(TIME, satellite=[5], signal=[signal_number("9Z")], pseudorange_m=[2e7]), 1) == []


TABLE_3_5_75 = (
    (63, 0.063),
    (64, 0.064),
    (95, 0.126),
    (96, 0.128),
    (127, 0.252),
    (160, 0.512),
    (416, 131.072),
    (703, 66060.288),
    (704, 67108.864),
)


@pytest.mark.parametrize(("indicator", "seconds"), TABLE_3_5_75)
def test_lock_time_follows_the_table(indicator: int, seconds: float):
    """DF407, RTCM 10403.3 table 3.5-75."""
    assert lock_time_s(indicator, extended=True) == pytest.approx(seconds, abs=1e-9)


def test_short_lock_times_are_powers_of_two():
    """DF402: 0, then 32 ms doubled up to 524.288 s; reserved DF407 values have no meaning."""
    assert [lock_time_s(i, extended=False) for i in (0, 1, 2, 15)] == pytest.approx([0.0, 0.032, 0.064, 524.288])
    assert np.isnan(lock_time_s(705, extended=True))


@settings(max_examples=60, deadline=None)
@given(cut=st.integers(0, 400), seed=st.integers(0, 1000))
def test_truncated_and_random_payloads_are_rejected_not_read_over(cut: int, seed: int):
    """Every length is checked before a bit is read: a payload shorter than its masks demand has a reason, never a value."""
    rng = np.random.default_rng(seed)
    part, reason, _, _ = decode_msm(b"\x43\x50" + rng.bytes(cut), 1077, np.zeros(64, np.int8), Rows())
    assert (part is None) == (reason != "")


@settings(max_examples=30, deadline=None)
@given(
    lat_rad=st.floats(-1.57, 1.57), lon_rad=st.floats(-3.14, 3.14), altitude_m=st.floats(-4000.0, 9000.0),
    height_m=st.floats(0.0, 6.5), texts=st.tuples(*(st.text("ABCdef123 ._-", max_size=31),) * 3), station_id=st.integers(0, 4095),
)  # fmt: skip
def test_a_station_comes_back(
    lat_rad: float, lon_rad: float, altitude_m: float, height_m: float, texts: tuple[str, str, str], station_id: int
):
    """1006 and 1033 give the position to 0.1 mm, the height and the texts."""
    x, y, z = ecef_from_geodetic(lat_rad, lon_rad, altitude_m).tolist()
    position = (x, y, z)
    antenna, serial, receiver = (text.strip() for text in texts)
    station = ReferenceStation(station_id, position, height_m, antenna, serial, receiver, "rtcm3")
    got = decode(encode_station(station))[-1]
    assert isinstance(got, ReferenceStation)
    assert got.position_ecef_m is not None
    assert np.abs(np.subtract(got.position_ecef_m, position)).max() < 5.1e-5
    assert abs(got.antenna_height_m - height_m) < 5.1e-5
    assert replace(got, position_ecef_m=None, antenna_height_m=0.0) == replace(station, position_ecef_m=None, antenna_height_m=0.0)


def test_a_glonass_bias_comes_back_with_what_was_not_sent():
    bias = GlonassBias(77, True, (-71.94, float("nan"), 0.02, float("nan")))
    (got,) = decode([encode_glonass_bias(bias)])
    assert isinstance(got, GlonassBias)
    assert (got.station_id, got.aligned) == (77, True)
    np.testing.assert_allclose(got.bias_m, bias.bias_m, atol=1e-9)


def test_an_infinite_value_is_sent_as_invalid():
    """Infinite pseudoranges, phases, Dopplers and C/N0 are no values; fields stay within their width."""
    one = make_epoch(
        TIME, satellite=[5, 6], signal=[28, 28], pseudorange_m=[2e7, inf], phase_cyc=[inf, inf], doppler_hz=[inf, -inf], cn0_dbhz=[1e9, inf]
    )
    (got,) = decode(encode_epoch(one, 1))
    assert isinstance(got, Epoch)
    assert got.satellite.tolist() == [5]
    assert all(np.isnan(getattr(got, field.name)).all() for field in fields(got) if field.name in ("phase_cyc", "doppler_hz"))
