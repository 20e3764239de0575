"""Single-point positioning: exact on exact data, indifferent to order, and not to be led astray."""

from dataclasses import replace

import numpy as np
import pytest

from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.epoch import Epoch, make_epoch
from rtkmesh.gnss.signals import SYSTEMS, carrier_hz, satellite_number, signal_number
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.single import IonosphereModel, SinglePoint, SinglePointOptions, SingleStatus, single_point

CLOCKS_M = {"G": 30000.0, "R": 30055.0, "E": 29990.0, "C": 30012.0, "J": 30000.0}


def error_m(solution: SinglePoint, place_ecef_m: np.ndarray) -> float:
    assert solution.ok, solution.status
    return float(np.linalg.norm(solution.position_ecef_m - place_ecef_m))


def with_faults(epoch: Epoch, faults_m: dict[int, float]) -> Epoch:
    codes = epoch.pseudorange_m.copy()
    for row, fault_m in faults_m.items():
        codes[row] += fault_m
    return replace(epoch, pseudorange_m=codes)


def test_exact_codes_give_the_exact_position_and_clocks_from_the_earths_centre(sky, noon, place_ecef_m):
    epoch = sky.epoch(noon, place_ecef_m, CLOCKS_M)
    solution = single_point(epoch, sky.table)
    assert error_m(solution, place_ecef_m) < 1e-3
    assert solution.used.sum() == len(np.unique(epoch.satellite))
    assert solution.rejected == ()
    assert solution.receiver_clock_s * SPEED_OF_LIGHT_MPS == pytest.approx(30000.0, abs=1e-3)
    by_system = dict(zip(SYSTEMS, solution.clock_s * SPEED_OF_LIGHT_MPS, strict=True))
    for letter in "GREC":
        assert by_system[letter] == pytest.approx(CLOCKS_M[letter], abs=1e-3)
    assert np.isnan(by_system["I"])
    assert np.abs(solution.residual_m[solution.used]).max() < 1e-3
    assert solution.degrees_of_freedom == solution.used.sum() - 7
    assert 0.3 < solution.pdop < 3.0


def test_the_start_changes_nothing(sky, noon, place_ecef_m):
    epoch = sky.epoch(noon, place_ecef_m)
    ends = [
        single_point(epoch, sky.table, initial_ecef_m=start).position_ecef_m
        for start in (None, place_ecef_m + 100.0, place_ecef_m + 5e5, -place_ecef_m, np.full(3, np.nan))
    ]
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], atol=1e-3)


def test_a_millisecond_clock_and_a_week_later_are_the_same(make_sky, noon, place_ecef_m):
    positions = []
    for weeks, clock_m in ((0, 0.0), (1, 0.0), (0, 3e5), (0, -3e5)):
        at = noon + weeks * 604800.0
        sky = make_sky(at)
        solution = single_point(sky.epoch(at, place_ecef_m, clock_m), sky.table)
        assert solution.receiver_clock_s == pytest.approx(clock_m / SPEED_OF_LIGHT_MPS, abs=1e-11)
        positions.append(solution.position_ecef_m)
    np.testing.assert_allclose(positions, np.tile(place_ecef_m, (4, 1)), atol=1e-3)


@pytest.mark.parametrize("systems", ["G", "E", "C", "R", "GR", "GREC"])
def test_each_system_alone_and_together(sky, noon, place_ecef_m, systems):
    solution = single_point(sky.epoch(noon, place_ecef_m, CLOCKS_M), sky.table, SinglePointOptions(systems=systems))
    assert error_m(solution, place_ecef_m) < 1e-3
    assert {SYSTEMS[s // 64] for s in solution.satellites} == set(systems)


@pytest.mark.parametrize("faults", [1, 3, 6])
@pytest.mark.parametrize("size_m", [60.0, 3e3, 2e6])
def test_outliers_are_put_aside_and_named(sky, noon, place_ecef_m, faults, size_m):
    """Up to a quarter of the satellites, a third of each system, all wrong in one direction: from reflections to garbage."""
    random = np.random.default_rng(int(size_m) + faults)
    epoch = sky.epoch(noon, place_ecef_m, CLOCKS_M)
    epoch = replace(epoch, pseudorange_m=epoch.pseudorange_m + random.normal(0.0, 0.5, len(epoch)))
    rows = [row for k in range(4) for row in random.permutation(np.flatnonzero(epoch.satellite // 64 == k))[:2]][:faults]
    clean = single_point(epoch, sky.table)
    solution = single_point(with_faults(epoch, {int(row): size_m * random.uniform(1.0, 1.5) for row in rows}), sky.table)
    assert error_m(solution, clean.position_ecef_m) < 1.5
    assert set(solution.rejected) == {int(epoch.satellite[row]) for row in rows}


def test_what_was_dropped_wrongly_on_the_way_comes_back(sky, noon, place_ecef_m):
    """With an outlier of 80 m only that one satellite ends outside, though the first fit spreads it over many."""
    epoch = sky.epoch(noon, place_ecef_m)
    for row in range(0, len(epoch), 5):
        solution = single_point(with_faults(epoch, {row: 80.0}), sky.table, SinglePointOptions(systems="GEC"))
        expected = () if SYSTEMS[epoch.satellite[row] // 64] == "R" else (int(epoch.satellite[row]),)
        assert solution.rejected == expected


def test_five_satellites_detect_but_cannot_name(sky, noon, place_ecef_m):
    """One degree of freedom: a gross contradiction is refused, a small one widens the covariance."""
    gps = sky.epoch(noon, place_ecef_m)
    few = gps.take(np.flatnonzero(gps.satellite < 64)[:5])
    assert error_m(single_point(few, sky.table), place_ecef_m) < 1e-3
    gross = single_point(with_faults(few, {2: 5000.0}), sky.table)
    assert gross.status is SingleStatus.INCONSISTENT
    assert np.isnan(gross.position_ecef_m).all()
    small = single_point(with_faults(few, {2: 20.0}), sky.table)
    if small.ok and small.chi_square > small.degrees_of_freedom:
        assert np.trace(small.position_cov_ecef_m2) > np.trace(single_point(few, sky.table).position_cov_ecef_m2)


def test_too_little_is_said_so(sky, noon, place_ecef_m):
    epoch = sky.epoch(noon, place_ecef_m)
    gps = epoch.take(np.flatnonzero(epoch.satellite < 64)[:3])
    assert single_point(gps, sky.table).status is SingleStatus.FEW_SATELLITES
    assert single_point(epoch.take(np.arange(0)), sky.table).status is SingleStatus.FEW_SATELLITES
    assert single_point(epoch, EphemerisTable()).status is SingleStatus.NO_EPHEMERIS
    two_and_two = epoch.take(np.array([0, 1, len(epoch) - 2, len(epoch) - 1]))
    assert single_point(two_and_two, sky.table).status is SingleStatus.FEW_SATELLITES
    narrow = SinglePointOptions(elevation_mask_rad=1.2)
    assert single_point(epoch, sky.table, narrow).status in (SingleStatus.FEW_SATELLITES, SingleStatus.POOR_GEOMETRY)


def test_masks_and_exclusions_are_obeyed(sky, noon, place_ecef_m):
    epoch = sky.epoch(noon, place_ecef_m)
    name = f"G{int(epoch.satellite[0]):02d}"
    solution = single_point(epoch, sky.table, SinglePointOptions(excluded=(name,), elevation_mask_rad=0.5))
    assert satellite_number(name) not in solution.satellites
    assert (solution.elevation_rad[solution.used] >= 0.5).all()
    assert solution.used.sum() < len(solution.satellites)
    weak = make_epoch(noon, **{name: getattr(epoch, name) for name in ("satellite", "signal", "pseudorange_m", "channel")},
                      cn0_dbhz=np.where(np.arange(len(epoch)) % 3 == 0, 20.0, 45.0))  # fmt: skip
    strong = single_point(weak, sky.table, SinglePointOptions(cn0_mask_dbhz=30.0))
    assert len(strong.satellites) == len(epoch) - (len(epoch) + 2) // 3


def moving_epoch(sky, noon, place_ecef_m: np.ndarray, velocity: np.ndarray, clock_mps: float) -> Epoch:
    """Dopplers from the change of the whole simulated code over a second: no formula of the velocity model takes part."""
    half = 0.5 * velocity
    before = sky.pseudoranges(noon + -0.5, place_ecef_m - half, dict.fromkeys(SYSTEMS, 100.0 - 0.5 * clock_mps))
    after = sky.pseudoranges(noon + 0.5, place_ecef_m + half, dict.fromkeys(SYSTEMS, 100.0 + 0.5 * clock_mps))
    epoch = sky.epoch(noon, place_ecef_m, 100.0)
    rate = dict(zip(sky.satellites.tolist(), after - before, strict=True))
    hz = [carrier_hz(int(s), int(c), int(ch)) for s, c, ch in zip(epoch.satellite, epoch.signal, epoch.channel, strict=True)]
    doppler = [-rate[int(s)] * f / SPEED_OF_LIGHT_MPS for s, f in zip(epoch.satellite, hz, strict=True)]
    return replace(epoch, doppler_hz=np.array(doppler))


def test_velocity_is_that_of_the_motion(sky, noon, place_ecef_m):
    sky.atmosphere = 0.0
    velocity = np.array([12.0, -7.0, 3.5])
    epoch = moving_epoch(sky, noon, place_ecef_m, velocity, -45.0)
    options = SinglePointOptions(ionosphere=IonosphereModel.OFF, troposphere=False)
    solution = single_point(epoch, sky.table, options)
    np.testing.assert_allclose(solution.velocity_ecef_mps, velocity, atol=5e-4)
    assert solution.clock_rate * SPEED_OF_LIGHT_MPS == pytest.approx(-45.0, abs=5e-4)
    assert np.linalg.eigvalsh(solution.velocity_cov_ecef_m2ps2).min() > 0.0


def test_wrong_and_missing_dopplers_do_not_reach_the_velocity(sky, noon, place_ecef_m):
    sky.atmosphere = 0.0
    epoch = moving_epoch(sky, noon, place_ecef_m, np.zeros(3), 5.0)
    doppler = epoch.doppler_hz.copy()
    doppler[[1, 8, 20]] += [300.0, -80.0, 5.0]
    doppler[[3, 4]] = np.nan
    options = SinglePointOptions(ionosphere=IonosphereModel.OFF, troposphere=False)
    solution = single_point(replace(epoch, doppler_hz=doppler), sky.table, options)
    np.testing.assert_allclose(solution.velocity_ecef_mps, 0.0, atol=1e-3)
    assert np.isnan(solution.rate_residual_mps[[1, 3, 4, 8, 20]]).all()
    none = single_point(replace(epoch, doppler_hz=np.full(len(epoch), np.nan)), sky.table, options)
    assert none.ok
    assert not none.has_velocity


def test_covariances_are_honest_for_white_noise(sky, noon, place_ecef_m):
    """Normalised squared error over 60 draws of the modelled noise averages to 3, scaled for the parts that the draws leave out."""
    epoch, random = sky.epoch(noon, place_ecef_m), np.random.default_rng(7)
    options = SinglePointOptions(code_a_m=10.0, code_b_m=0.0, ionosphere=IonosphereModel.KLOBUCHAR)
    nees = []
    for _ in range(60):
        noisy = replace(epoch, pseudorange_m=epoch.pseudorange_m + random.normal(0.0, 10.0, len(epoch)))
        solution = single_point(noisy, sky.table, options)
        error = solution.position_ecef_m - place_ecef_m
        nees.append(error @ np.linalg.solve(solution.position_cov_ecef_m2, error))
    assert 1.5 < np.mean(nees) < 4.5


def dual_band(sky, noon, place_ecef_m) -> Epoch:
    """The same sky through twice the ionosphere, with GPS and Galileo on two bands each."""
    sky.atmosphere = 1.0
    epoch, free = sky.epoch(noon, place_ecef_m), None
    sky.atmosphere = 0.0
    free = sky.epoch(noon, place_ecef_m)
    two = {0: ("2W", (154 / 120) ** 2), 2: ("5Q", (154 / 115) ** 2)}
    keep = np.isin(epoch.satellite // 64, list(two))
    satellites, slant = epoch.satellite[keep], 2.0 * (epoch.pseudorange_m - free.pseudorange_m)[keep]
    codes = free.pseudorange_m[keep]
    second = [signal_number(two[int(s) // 64][0]) for s in satellites]
    factor = np.array([two[int(s) // 64][1] for s in satellites])
    return make_epoch(
        noon, satellite=np.tile(satellites, 2), signal=np.concatenate([epoch.signal[keep], second]),
        pseudorange_m=np.concatenate([codes + slant, codes + factor * slant]),
    )  # fmt: skip


def test_two_bands_remove_an_ionosphere_that_the_model_does_not_know(noon, place_ecef_m, make_kepler, sky):
    """What multiplies like an ionosphere (here model and troposphere alike, twice over) vanishes from the combination."""
    bare = type(sky)().add(make_kepler(f"{s}{n:02d}", group_delay_s=(0.0, 0.0)) for s in "GE" for n in range(6, 27))
    epoch = dual_band(bare, noon, place_ecef_m)
    free = SinglePointOptions(ionosphere=IonosphereModel.FREE, troposphere=False)
    model = SinglePointOptions(ionosphere=IonosphereModel.KLOBUCHAR, troposphere=False)
    assert error_m(single_point(epoch, bare.table, free), place_ecef_m) < 1e-3
    assert error_m(single_point(epoch, bare.table, model), place_ecef_m) > 1.0


def test_broadcast_parameters_replace_the_default_ones(sky, noon, place_ecef_m):
    strong = KlobucharParameters("G", (5e-8, 0.0, 0.0, 0.0), (2.5e5, 0.0, 0.0, 0.0))
    epoch = sky.epoch(noon, place_ecef_m)
    default, other = single_point(epoch, sky.table), single_point(epoch, sky.table, SinglePointOptions(klobuchar=strong))
    assert np.linalg.norm(default.position_ecef_m - other.position_ecef_m) > 0.5


def test_the_best_code_of_a_satellite_is_taken_whatever_else_it_sends(sky, noon, place_ecef_m):
    """A worse code on another band, wrong by kilometres, is not looked at."""
    epoch = sky.epoch(noon, place_ecef_m)
    gps = epoch.take(np.flatnonzero(epoch.satellite < 64))
    both = make_epoch(
        noon, satellite=np.tile(gps.satellite, 2), signal=np.repeat([signal_number("5Q"), signal_number("1C")], len(gps)),
        pseudorange_m=np.concatenate([gps.pseudorange_m + 7e3, gps.pseudorange_m]),
    )  # fmt: skip
    assert error_m(single_point(both, sky.table), place_ecef_m) < 1e-3
