"""Base epochs between two: exact where all is linear, and never a fraction of a cycle."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, SYSTEMS, carrier_hz, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.geometry import ELEVATION, GEOMETRY, IONOSPHERE_L1_M, RANGE, TROPOSPHERE_M, receiver_model
from rtkmesh.models.orbit import STATE, STATE_CLOCK
from rtkmesh.rtk.noise import CLOCK_DRIFT_MPS
from rtkmesh.rtk.resampling import resampled
from rtkmesh.simulation.sky import CHANNELS, KLOBUCHAR, SATELLITES, broadcast

Vector = NDArray[np.float64]

START = GpsTime(2445, 100000.0)
GAP_S = 30.0
BASE_ECEF_M = ecef_from_geodetic(radians(47.0), radians(8.0), 400.0)
_SIGNALS = {"G": ("1C", "2W"), "R": ("1C", "2C"), "E": ("1C", "7Q"), "C": ("2I", "7I"), "J": ("1C", "2L")}
_L1_HZ = 1575.42e6


def known(satellites: list[int]) -> EphemerisTable:
    table = EphemerisTable()
    for satellite in satellites:
        table.add(broadcast(satellite, START))
    return table


TABLE = known(SATELLITES.tolist())


def modelled(tag: GpsTime, clock_s: float, table: EphemerisTable = TABLE) -> tuple[Vector, Vector, Vector]:
    """Return ranges (m) at a tag of a receiver whose clock is so much ahead, ionospheres on L1 (m) and elevations, per satellite."""
    code_m, states, geometry = np.full(len(SATELLITES), 2.4e7), np.empty((len(SATELLITES), STATE)), np.empty((len(SATELLITES), GEOMETRY))
    rows = table.select(SATELLITES, tag)
    for _ in range(4):
        receiver_model(rows, tag.week, tag.tow_s, code_m, BASE_ECEF_M, klobuchar_vector(KLOBUCHAR), states, geometry)
        code_m = geometry[:, RANGE] + SPEED_OF_LIGHT_MPS * (clock_s - states[:, STATE_CLOCK]) + geometry[:, TROPOSPHERE_M]
    return code_m, geometry[:, IONOSPHERE_L1_M].copy(), geometry[:, ELEVATION].copy()


def observed(after_s: float, clock_s: float = 0.0, *, satellite_m: float = 0.0, phase_clock_s: float | None = None) -> Epoch:
    """Return what a base sees ``after_s`` START: whole cycles, and per satellite what no model knows, up to 0.3 mm/s.

    ``satellite_m`` comes on top for the first satellite; the clock of the phases may be another one than that of the codes.
    """
    code_m, ionosphere_m, elevation = modelled(START + after_s, clock_s)
    phase_m = code_m + SPEED_OF_LIGHT_MPS * ((clock_s if phase_clock_s is None else phase_clock_s) - clock_s)
    rows: list[tuple[int, int, int, float, float]] = []
    for i in np.flatnonzero(elevation > 0.2).tolist():
        satellite, channel = int(SATELLITES[i]), int(CHANNELS[i])
        unmodelled_m = 3e-4 * np.sin(satellite) * after_s + (satellite_m if not rows or rows[0][0] == satellite else 0.0)
        for code in _SIGNALS[SYSTEMS[satellite // SATELLITES_PER_SYSTEM]]:
            hz = carrier_hz(satellite, signal_number(code), channel)
            delay_m = ionosphere_m[i] * (_L1_HZ / hz) ** 2
            cycles = (phase_m[i] - delay_m + unmodelled_m) * hz / SPEED_OF_LIGHT_MPS + 1000.0 * satellite
            rows.append((satellite, signal_number(code), channel, code_m[i] + delay_m + unmodelled_m, cycles))
    satellite, signal, channel, code, phase = (np.array(column) for column in zip(*rows, strict=True))
    count = len(rows)
    return make_epoch(
        START + after_s, satellite=satellite, signal=signal, channel=channel, pseudorange_m=code, phase_cyc=phase,
        cn0_dbhz=np.full(count, 45.0 - 0.1 * after_s), lock_s=np.full(count, 100.0 + after_s), flags=np.zeros(count, np.uint8),
    )  # fmt: skip


def wavelengths_m(epoch: Epoch) -> Vector:
    rows = zip(epoch.satellite.tolist(), epoch.signal.tolist(), epoch.channel.tolist(), strict=True)
    return np.array([SPEED_OF_LIGHT_MPS / carrier_hz(*row) for row in rows])


def between(earlier: Epoch, later: Epoch, after_s: float, *, slips_told: bool = True, table: EphemerisTable = TABLE) -> Epoch | None:
    return resampled(earlier, later, START + after_s, table.issues, np.array(BASE_ECEF_M), KLOBUCHAR, slips_told=slips_told)


def made(earlier: Epoch, later: Epoch, after_s: float, *, slips_told: bool = True) -> Epoch:
    epoch = between(earlier, later, after_s, slips_told=slips_told)
    assert epoch is not None
    return epoch


FIRST, LAST = observed(0.0), observed(GAP_S)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 29.9), st.floats(-1e-3, 1e-3), st.floats(-1e-6, 1e-6))
def test_what_is_linear_beside_the_models_is_exact(after_s: float, clock_s: float, drift: float) -> None:
    """Codes to 0.1 mm, phases to 0.001 cycles, whatever the receiver's clock is and however fast it drifts."""
    first, last = observed(0.0, clock_s), observed(GAP_S, clock_s + GAP_S * drift)
    epoch, true = made(first, last, after_s), observed(after_s, clock_s + after_s * drift)
    assert (epoch.time, len(epoch)) == (true.time, len(first))
    assert np.array_equal(epoch.satellite, first.satellite)
    assert np.array_equal(epoch.signal, first.signal)
    assert epoch.pseudorange_m == pytest.approx(true.pseudorange_m, abs=1e-4)
    assert np.abs(epoch.phase_cyc - true.phase_cyc).max() < 1e-3


def test_straight_lines_would_be_metres_off() -> None:
    """What the models are for: satellites accelerate."""
    straight_m = 0.5 * (FIRST.pseudorange_m + LAST.pseudorange_m)
    assert np.abs(straight_m - observed(15.0).pseudorange_m).max() > 5.0


@pytest.mark.parametrize("phases_follow", [True, False])
def test_a_clock_that_jumps_by_a_millisecond_changes_nothing_between_signals(phases_follow: bool) -> None:
    """The clock of the epoch is one between both; against it codes and phases are as they were."""
    epoch = made(FIRST, observed(GAP_S, 1e-3, phase_clock_s=None if phases_follow else 0.0), 12.0)
    true = observed(12.0, 0.4e-3, phase_clock_s=None if phases_follow else 0.0)
    assert epoch.pseudorange_m == pytest.approx(true.pseudorange_m, abs=1e-3)
    assert np.abs(epoch.phase_cyc - true.phase_cyc).max() < 5e-3


@settings(max_examples=60, deadline=None)
@given(
    st.dictionaries(st.integers(0, len(FIRST) - 1), st.integers(-40, 40).filter(bool), max_size=len(FIRST) // 3),
    st.floats(0.5, 29.5),
    st.booleans(),
)
def test_a_slip_is_never_interpolated(slips: dict[int, int], after_s: float, flagged: bool) -> None:
    """Half a cycle or twenty: where it is told the phase goes on as it was before, else there is none; all others are exact."""
    jump, flags = np.zeros(len(LAST)), LAST.flags.copy()
    for row, halves in slips.items():
        jump[row], flags[row] = 0.5 * halves, SLIP if flagged else 0
    epoch, true = made(FIRST, replace(LAST, phase_cyc=LAST.phase_cyc + jump, flags=flags), after_s), observed(after_s)
    slipped = jump != 0.0
    apart = np.abs(epoch.phase_cyc - true.phase_cyc)
    assert apart[~slipped].max() < 2e-3
    sigma_m = epoch.phase_sigma_cyc * wavelengths_m(FIRST)
    assert (sigma_m[~slipped] < 0.012).all()
    if flagged:
        assert (apart[slipped] < 0.2).all(), "what drifts is not interpolated, and the clock is the others'"
        assert sigma_m[slipped] == pytest.approx(CLOCK_DRIFT_MPS * after_s)
    else:
        assert np.isnan(epoch.phase_cyc[slipped]).all()


def test_what_only_one_epoch_has() -> None:
    """A satellite that has set goes on with the clock of the others; one that rises is not there before its epoch."""
    gone = FIRST.satellite == FIRST.satellite[-1]
    epoch, true = made(FIRST, LAST.take(~gone), 10.0), observed(10.0)
    assert epoch.pseudorange_m == pytest.approx(true.pseudorange_m, abs=0.05)
    assert np.abs(epoch.phase_cyc - true.phase_cyc).max() < 0.1
    assert np.array_equal(made(FIRST.take(~gone), LAST, 10.0).satellite, FIRST.satellite[~gone])


def test_half_cycles_that_are_open_stay_so() -> None:
    """A phase with an open half cycle is none; one that is only open later goes on from the earlier epoch."""
    flags = FIRST.flags.copy()
    flags[3] = HALF_CYCLE
    epoch = made(replace(FIRST, flags=flags), LAST, 10.0)
    assert np.isnan(epoch.phase_cyc[3])
    assert epoch.flags[3] == HALF_CYCLE
    epoch = made(FIRST, replace(LAST, flags=flags, phase_cyc=np.where(flags > 0, LAST.phase_cyc + 0.5, LAST.phase_cyc)), 10.0)
    assert abs(epoch.phase_cyc[3] - observed(10.0).phase_cyc[3]) < 0.1
    assert epoch.flags[3] == 0


def test_a_clock_of_a_satellite_that_wanders_shows_on_both_bands() -> None:
    """It is interpolated, with a sigma that knows; on one band alone it could be a slip."""
    later = observed(GAP_S, satellite_m=0.14)
    own = later.satellite == later.satellite[0]
    epoch, true = made(FIRST, later, 15.0), observed(15.0, satellite_m=0.07)
    assert np.abs(epoch.phase_cyc - true.phase_cyc).max() < 2e-3
    assert (epoch.phase_sigma_cyc[own] > 0.2).all()
    one = ~own | (later.signal == later.signal[0])
    alone = made(FIRST.take(one), later.take(one), 15.0)
    assert np.flatnonzero(np.isnan(alone.phase_cyc)).tolist() == [0]


def test_phases_that_do_not_agree_give_nothing() -> None:
    """The antenna was moved, or the receiver began anew: no clock fits most phases."""
    apart = np.arange(len(LAST)) % 5 - 2.0
    assert between(FIRST, replace(LAST, phase_cyc=LAST.phase_cyc + apart), 10.0) is None
    assert between(FIRST, replace(LAST, lock_s=np.full(len(LAST), 2.0)), 10.0) is None
    assert between(FIRST, replace(LAST, phase_cyc=np.full(len(LAST), np.nan)), 10.0) is None


def test_an_issue_that_changes_between_the_epochs_is_none() -> None:
    """Both epochs are modelled with the one that counts at the rover's instant: another one, metres off, gives the same observations."""
    other = EphemerisTable()
    for satellite in SATELLITES.tolist():
        issue = broadcast(satellite, START)
        changed = {"af0_s": issue.af0_s + 1e-8, "crc_m": issue.crc_m + 3.0} if hasattr(issue, "af0_s") else {"tau_s": issue.tau_s + 1e-8}
        other.add(replace(issue, **changed))
    epoch = between(FIRST, LAST, 17.0, table=other)
    assert epoch is not None
    assert np.abs(epoch.phase_cyc - observed(17.0).phase_cyc).max() < 2e-3


def test_satellites_without_ephemeris_keep_their_rows_and_have_no_values() -> None:
    first = int(FIRST.satellite[0])
    epoch = between(FIRST, LAST, 10.0, table=known([s for s in SATELLITES.tolist() if s != first]))
    assert epoch is not None
    without = epoch.satellite == first
    assert np.isnan(epoch.pseudorange_m[without]).all()
    assert np.isnan(epoch.phase_cyc[without]).all()
    assert np.isfinite(epoch.phase_cyc[~without]).all()


def test_words_of_the_receiver() -> None:
    """Slips count once, the weaker C/N0 and the shorter lock count, sigmas of the receiver and of the interpolation add up."""
    flagged = replace(FIRST, flags=np.full(len(FIRST), SLIP, np.uint8))
    assert (made(flagged, LAST, 10.0, slips_told=False).flags == SLIP).all()
    assert (made(flagged, LAST, 10.0).flags == 0).all()
    epoch = made(FIRST, LAST, 10.0)
    assert epoch.cn0_dbhz == pytest.approx(LAST.cn0_dbhz)
    assert epoch.lock_s == pytest.approx(FIRST.lock_s + 10.0)
    coarse = made(replace(FIRST, lock_s=np.full(len(FIRST), 64.0)), replace(LAST, lock_s=np.full(len(LAST), 64.0)), 10.0)
    assert (coarse.lock_s == 64.0).all(), "a lower bound that does not grow (RTCM DF402) is no loss of lock"
    told = replace(FIRST, phase_sigma_cyc=np.full(len(FIRST), 0.05), pseudorange_sigma_m=np.full(len(FIRST), 0.4))
    said = made(told, LAST, 10.0)
    assert said.phase_sigma_cyc == pytest.approx(np.hypot(0.05, epoch.phase_sigma_cyc))
    assert (said.pseudorange_sigma_m == 0.4).all()
