"""UBX frames made of values: what the decoder reads of them."""

from dataclasses import fields, replace
from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.subframes_encode import beidou_parity, lnav_parity
from rtkmesh.codecs.ubx import UbxDecoder
from rtkmesh.codecs.ubx_encode import encode_ephemeris, encode_ionosphere, encode_nav_pvt, encode_rawx, frame
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage, ReceiverFix
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.signals import satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.sky import SATELLITES, broadcast

TIME = GpsTime(2445, 529200.0 + 3600.0)
SIGNALS = [
    ("G05", "1C"),
    ("G05", "2L"),
    ("R07", "1C"),
    ("R07", "2C"),
    ("E11", "1C"),
    ("E11", "7Q"),
    ("C23", "2I"),
    ("C23", "7I"),
    ("J02", "1C"),
    ("S23", "1C"),
]


def decoded(data: bytes, decoder: UbxDecoder | None = None) -> list[Message]:
    decoder = decoder or UbxDecoder(TIME)
    found = [message for part in Framer().feed(data) for message in decoder.decode(part)]
    assert not decoder.counters.rejected
    return found


def epoch_of(rows: list[tuple[str, str]], **columns: object) -> Epoch:
    satellites, signals = (
        [f(x) for x in column] for f, column in zip((satellite_number, signal_number), zip(*rows, strict=True), strict=True)
    )
    channels = [5 if name.startswith("R") else 127 for name, _ in rows]
    return make_epoch(TIME, satellite=satellites, signal=signals, channel=channels, **columns)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(1.9e7, 4.5e7), st.floats(-1e9, 1e9), st.floats(-6e3, 6e3, width=32), st.floats(10.0, 60.0), st.integers(0, 64000),
            st.sampled_from([0, HALF_CYCLE]),
        ),
        min_size=len(SIGNALS), max_size=len(SIGNALS),
    )
)  # fmt: skip
def test_rawx_brings_observations_back(values: list[tuple[float, float, float, float, int, int]]):
    """Codes, phases and Dopplers exactly, C/N0 in whole dB-Hz, lock times in milliseconds, half cycles and channels as they were."""
    code, phase, doppler, cn0, lock_ms, flags = (list(column) for column in zip(*values, strict=True))
    sent = epoch_of(
        SIGNALS, pseudorange_m=code, phase_cyc=phase, doppler_hz=doppler, cn0_dbhz=cn0, lock_s=np.array(lock_ms) * 1e-3, flags=flags
    )
    found = decoded(encode_rawx(sent))[0]
    assert isinstance(found, Epoch)
    for name in ("satellite", "signal", "channel", "pseudorange_m", "phase_cyc", "doppler_hz"):
        assert np.array_equal(getattr(found, name), getattr(sent, name)), name
    assert np.array_equal(found.flags & HALF_CYCLE, sent.flags & HALF_CYCLE)
    assert np.abs(found.cn0_dbhz - sent.cn0_dbhz).max() <= 0.5
    assert np.abs(found.lock_s - sent.lock_s).max() <= 1.1e-3


def test_rawx_tells_what_was_not_observed():
    """A missing code or phase stays missing, sigmas are rounded up, an unknown signal is left out."""
    rows = [("G05", "1C"), ("G05", "2L"), ("G05", "8X"), ("E11", "1C")]
    sent = epoch_of(
        rows, pseudorange_m=[2e7, np.nan, 2e7, 2.5e7], phase_cyc=[1e8, 1e8, 1e8, np.nan], lock_s=[1.0] * 4, pseudorange_sigma_m=[0.3] * 4,
        phase_sigma_cyc=[0.009] * 4,
    )  # fmt: skip
    found = decoded(encode_rawx(sent))[0]
    assert isinstance(found, Epoch)
    assert [row[:2] for row in found.rows()] == [("G05", "1C"), ("G05", "2L"), ("E11", "1C")]
    assert np.isnan(found.pseudorange_m).tolist() == [False, True, False]
    assert np.isnan(found.phase_cyc).tolist() == [False, False, True]
    assert found.pseudorange_sigma_m.tolist() == pytest.approx([0.32] * 3)
    assert found.phase_sigma_cyc[:2].tolist() == pytest.approx([0.012] * 2)


def test_a_half_cycle_that_is_subtracted_is_a_slip_to_the_decoder():
    """The bit's change between two epochs tells that the phase moved by half a cycle."""
    decoder = UbxDecoder(TIME)
    columns = {"pseudorange_m": [2e7], "phase_cyc": [1e8], "lock_s": [2.0]}
    first = epoch_of([("G05", "1C")], flags=[HALF_CYCLE], **columns)
    second = replace(epoch_of([("G05", "1C")], **columns), time=TIME + 0.2)
    decoded(encode_rawx(first), decoder)
    found = decoded(encode_rawx(second, half_cycle_subtracted=np.array([True]), clock_reset=True), decoder)[0]
    assert isinstance(found, Epoch)
    assert found.flags.tolist() == [SLIP]
    assert decoder.clock_resets == 1


def resolution(name: str) -> float:
    """Half of the coarsest resolution with which any message of ours sends a number (from the interface documents)."""
    return {
        "sqrt_a": 2.0**-19, "eccentricity": 2.0**-33, "delta_n_radps": 3.6e-13, "omega_dot_radps": 3.6e-13, "idot_radps": 3.6e-13,
        "crc_m": 2.0**-5, "crs_m": 2.0**-5, "af0_s": 2.0**-31, "af1": 2.0**-43, "af2": 2.0**-55, "tau_s": 2.0**-30, "gamma": 2.0**-40,
    }.get(name, 1.9e-9) * 0.5001  # fmt: skip


def sent_at(ephemeris: Ephemeris) -> GpsTime:
    leap_s = 18.0 if isinstance(ephemeris, GlonassEphemeris) else 0.0
    return GpsTime(TIME.week, TIME.tow_s + leap_s)


@pytest.mark.parametrize("satellite", [int(s) for s in SATELLITES[::5]])
def test_ephemerides_come_back_within_the_resolution_of_their_fields(satellite: int):
    """Subframes, pages and strings of every system, decoded, give one ephemeris with the same issue, times and numbers."""
    sent = broadcast(satellite, TIME)
    found = [m for m in decoded(b"".join(encode_ephemeris(sent, sent_at(sent)))) if isinstance(m, KeplerEphemeris | GlonassEphemeris)]
    assert len(found) == 1
    for field in fields(sent):
        was, now = getattr(sent, field.name), getattr(found[0], field.name)
        if isinstance(was, float):
            assert abs(now - was) <= resolution(field.name), field.name
        elif field.name in ("position_m", "velocity_mps", "acceleration_mps2"):
            limit = {"position_m": 0.25, "velocity_mps": 4.8e-4, "acceleration_mps2": 5e-7}[field.name]
            assert np.abs(np.subtract(now, was)).max() <= limit
        elif field.name == "group_delay_s":
            assert np.abs(np.subtract(now, was)).max() <= 2.4e-10
        elif field.name != "transmitted":
            assert now == was, field.name


def test_what_was_decoded_is_encoded_to_the_same_bits():
    """Decoding and encoding again changes nothing, bit for bit."""
    for satellite in SATELLITES[::9].tolist():
        first = encode_ephemeris(broadcast(satellite, TIME), sent_at(broadcast(satellite, TIME)))
        found = [m for m in decoded(b"".join(first)) if isinstance(m, KeplerEphemeris | GlonassEphemeris)]
        assert encode_ephemeris(found[0], sent_at(found[0])) == first


def test_ionosphere_parameters_come_back():
    """Subframe 4 page 18 carries multiples of its resolutions unchanged, BeiDou's subframe 1 too."""
    parameters = KlobucharParameters("G", (11 * 2.0**-30, 2.0**-27, -(2.0**-24), 0.0), (44 * 2.0**11, -(2.0**14), 2.0**16, -(2.0**17)))
    assert decoded(encode_ionosphere(satellite_number("G05"), parameters, TIME)) == [parameters]
    ephemeris = broadcast(satellite_number("C23"), TIME)
    assert replace(parameters, system="C") in decoded(b"".join(encode_ephemeris(ephemeris, TIME, parameters)))


def test_messages_without_an_encoder_are_refused():
    """F/NAV has no form here."""
    ephemeris = broadcast(satellite_number("E05"), TIME)
    assert isinstance(ephemeris, KeplerEphemeris)
    with pytest.raises(ValueError, match="FNAV"):
        encode_ephemeris(replace(ephemeris, message=NavigationMessage.FNAV), TIME)


@pytest.mark.parametrize("fix", [0, 2, 3, 4, 5, 6])
def test_nav_pvt_brings_a_fix_back(fix: int):
    """Position to its 1e-7 degrees and millimetres, velocity to mm/s, kind of fix as it was."""
    sent = ReceiverFix(TIME, fix, radians(-33.9), radians(151.2), 61.234, 0.012, 0.02, (1.5, -2.25, 0.125), 17)
    found = decoded(encode_nav_pvt(sent))[0]
    assert isinstance(found, ReceiverFix)
    assert found.time == TIME
    assert (found.fix, found.satellites) == (fix, 17)
    assert (found.lat_rad, found.lon_rad) == pytest.approx((sent.lat_rad, sent.lon_rad), abs=2e-9)
    assert (found.height_m, found.horizontal_sigma_m, found.vertical_sigma_m) == pytest.approx((61.234, 0.012, 0.02))
    assert found.velocity_ned_mps == pytest.approx(sent.velocity_ned_mps)


def test_nav_pvt_needs_a_time():
    """The message cannot say 'unknown' with a position."""
    with pytest.raises(ValueError, match="time"):
        encode_nav_pvt(ReceiverFix(None, 3, 0.0, 0.0, 0.0, 1.0, 1.0, None, 5))


def test_frame_has_the_checksum_of_the_interface_description():
    """UBX-MON-VER poll, the frame that every terminal sends."""
    assert frame(0x0A, 0x04, b"") == bytes.fromhex("b5620a0400000e34")


def test_parities_of_zero_and_of_one_bit():
    """No data gives no parity; single data bits give the columns of the code's definition."""
    assert lnav_parity(0, 0) == 0
    assert lnav_parity(1 << 23, 0) == 0b101010
    assert lnav_parity(0, 0b10) == 0b101001
    assert lnav_parity(0, 0b01) == 0b010110
    assert beidou_parity(0) == 0
    assert beidou_parity(1) == 0b0011
