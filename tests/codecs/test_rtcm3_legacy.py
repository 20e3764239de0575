"""Legacy RTCM 3 observations: fields by hand, rolls of the phase, lengths."""

import numpy as np
import pytest

from rtkmesh.codecs.bits import BitWriter
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import encode_epoch, frame
from rtkmesh.codecs.rtcm3_legacy import lock_time_s
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import Epoch, make_epoch
from rtkmesh.gnss.signals import satellite_number, signal_code, signal_number
from rtkmesh.gnss.time import GpsTime

TIME = GpsTime(2009, 323125.0)
L1_HZ, L2_HZ = 1575.42e6, 1227.60e6


def gps_1004(tow_s: float, phase_steps: tuple[int, int], satellite: int = 5, sync: int = 0) -> bytes:
    """One satellite with pseudoranges of 22 000 000.00 m and 5 m more on L2, and these phase differences (0.5 mm)."""
    modulus, rest_m = divmod(22_000_000.0, SPEED_OF_LIGHT_MPS * 1e-3)
    writer = BitWriter()
    for value, length in ((1004, 12), (13, 12), (round(tow_s * 1e3), 30), (sync, 1), (1, 5), (0, 1), (0, 3), (satellite, 6), (0, 1)):
        writer.unsigned(value, length)
    writer.unsigned(round(rest_m / 0.02), 24)
    writer.signed(phase_steps[0], 20)
    for value, length in ((30, 7), (int(modulus), 8), (180, 8), (1, 2)):
        writer.unsigned(value, length)
    writer.signed(250, 14)
    writer.signed(phase_steps[1], 20)
    for value, length in ((127, 7), (0, 8)):
        writer.unsigned(value, length)
    return frame(writer.to_bytes())


def glonass_1010(channel: int, phase_steps: int) -> bytes:
    modulus, rest_m = divmod(21_000_000.0, SPEED_OF_LIGHT_MPS * 2e-3)
    moscow_ms = round(((TIME.tow_s - 18.0 + 10800.0) % 86400.0) * 1e3)
    writer = BitWriter()
    fields = (
        (1010, 12),
        (13, 12),
        (moscow_ms, 27),
        (0, 1),
        (1, 5),
        (0, 1),
        (0, 3),
        (7, 6),
        (0, 1),
        (channel + 7, 5),
        (round(rest_m / 0.02), 25),
    )
    for value, length in fields:
        writer.unsigned(value, length)
    writer.signed(phase_steps, 20)
    for value, length in ((0, 7), (int(modulus), 7), (160, 8)):
        writer.unsigned(value, length)
    return frame(writer.to_bytes())


def decode(*frames: bytes) -> list[Epoch]:
    decoder = Rtcm3Decoder(TIME)
    messages = [message for data in frames for message in decoder.decode(Frame(Protocol.RTCM3, "", data))]
    return [message for message in messages if isinstance(message, Epoch)]


def test_every_field_of_a_1004_is_where_it_belongs():
    """Pseudoranges with modulus, phases relative to L1, codes, C/N0 by quarters, minimum lock times."""
    (epoch,) = decode(gps_1004(TIME.tow_s, (2000, -4000)))
    assert [signal_code(int(signal)) for signal in epoch.signal] == ["1C", "2P"]
    np.testing.assert_allclose(epoch.pseudorange_m, [22_000_000.0, 22_000_005.0], atol=0.011)
    l1_m = epoch.pseudorange_m[0]
    np.testing.assert_allclose(
        epoch.phase_cyc, [(l1_m + 1.0) * L1_HZ / SPEED_OF_LIGHT_MPS, (l1_m - 2.0) * L2_HZ / SPEED_OF_LIGHT_MPS], atol=1e-6
    )
    np.testing.assert_allclose(epoch.cn0_dbhz, [45.0, np.nan])
    np.testing.assert_allclose(epoch.lock_s, [36.0, 937.0])


def test_glonass_1010_has_a_modulus_of_two_milliseconds_and_its_channel():
    """A stream of GLONASS alone says no day: its first five messages wait for a better time, the sixth is used."""
    (epoch,) = decode(*[glonass_1010(-3, 100)] * 6)
    assert epoch.time == TIME
    assert epoch.channel.tolist() == [-3]
    np.testing.assert_allclose(epoch.pseudorange_m, [21_000_000.0], atol=0.011)
    expected = (epoch.pseudorange_m[0] + 0.05) * (1602.0e6 - 3 * 0.5625e6) / SPEED_OF_LIGHT_MPS
    np.testing.assert_allclose(epoch.phase_cyc, [expected], atol=1e-6)


def test_a_roll_of_1500_cycles_is_undone():
    """When the difference leaves its field it is sent 1500 cycles away: the phase goes on as if nothing had happened."""
    steps = [round((260.0 + 0.6 * k - (1500.0 * SPEED_OF_LIGHT_MPS / L1_HZ if k > 3 else 0.0)) / 0.0005) for k in range(8)]
    epochs = decode(*(gps_1004(TIME.tow_s + k, (step, 0)) for k, step in enumerate(steps)))
    gap_m = [float(e.phase_cyc[0]) * SPEED_OF_LIGHT_MPS / L1_HZ - float(e.pseudorange_m[0]) for e in epochs]
    np.testing.assert_allclose(gap_m, [260.0 + 0.6 * k for k in range(8)], atol=0.0005)


def test_invalid_phases_and_second_frequencies_are_missing():
    """80000h is no phase; a second frequency with neither code nor phase gives no row."""
    (epoch,) = decode(gps_1004(TIME.tow_s, (-(1 << 19), -(1 << 19))))
    assert np.isnan(epoch.phase_cyc).all()
    assert np.isfinite(epoch.pseudorange_m).all()


def test_numbers_above_40_are_sbas():
    assert decode(gps_1004(TIME.tow_s, (0, 0), satellite=43))[0].satellite.tolist() == [satellite_number("S23")] * 2
    assert decode(gps_1004(TIME.tow_s, (0, 0), satellite=39)) == []


def test_a_cut_message_is_counted_as_too_short():
    decoder = Rtcm3Decoder(TIME)
    whole = gps_1004(TIME.tow_s, (0, 0))[3:-3]
    for length in range(2, len(whole) - 1):
        assert decoder.decode(Frame(Protocol.RTCM3, "1004", frame(whole[:length]))) == []
    assert decoder.counters.rejected == {"rtcm3/1004 too short": len(whole) - 3}


def test_legacy_beside_msm_is_redundant_but_not_when_alone():
    """Where both come the MSM make the epoch; when a stream turns to legacy messages they are used after one epoch."""
    msm = [make_epoch(TIME + k, satellite=[5], signal=[signal_number("1C")], pseudorange_m=[2.2e7], doppler_hz=[1.0]) for k in range(3)]
    both = [data for k in range(3) for data in (gps_1004(TIME.tow_s + k, (0, 0), sync=1), *encode_epoch(msm[k], 13))]
    alone = [gps_1004(TIME.tow_s + k, (0, 0)) for k in range(3, 8)]
    epochs = decode(*both, *alone)
    assert [epoch.time - TIME for epoch in epochs] == [0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.0]
    assert [bool(np.isfinite(epoch.doppler_hz[0])) for epoch in epochs] == [True] * 3 + [False] * 4


@pytest.mark.parametrize(
    ("indicator", "seconds"), [(0, 0), (23, 23), (24, 24), (47, 70), (48, 72), (71, 164), (72, 168), (96, 360), (126, 936), (127, 937)]
)
def test_lock_time_follows_the_table(indicator: int, seconds: int):
    """RTCM 10403.3 table 3.4-2."""
    assert lock_time_s(indicator) == seconds


def test_of_a_signal_in_both_kinds_of_message_the_msm_counts():
    """A legacy message with an SBAS satellite that an SBAS message of the same epoch holds as well: the row with the Doppler stays."""
    sbas = make_epoch(TIME, satellite=[satellite_number("S23")], signal=[signal_number("1C")], pseudorange_m=[2.3e7], doppler_hz=[1.0])
    (epoch,) = decode(gps_1004(TIME.tow_s, (0, 0), satellite=43, sync=1), *encode_epoch(sbas, 13))
    assert [signal_code(int(signal)) for signal in epoch.signal] == ["1C", "2P"]
    assert np.isfinite(epoch.doppler_hz).tolist() == [True, False]
