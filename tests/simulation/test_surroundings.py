"""What buildings and trees do to signals, by hand-made geometry, and what a receiver makes of it."""

from math import atan, cos, pi, sin

import numpy as np
import pytest

from rtkmesh.gnss.epoch import SLIP
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.receiver import Observed, Receiver, ReceiverOptions
from rtkmesh.simulation.surroundings import (
    ATTENUATION_DB,
    BLOCK_M,
    CODE_SIGMA_M,
    EXTRA_M,
    EXTRA_RATE_MPS,
    PATH,
    STREET_HALF_WIDTH_M,
    VIEW,
    city,
    city_view,
    diffraction_db,
    forest,
)
from rtkmesh.simulation.tracking import SignalOptions
from rtkmesh.simulation.trajectories import AntennaPath, Site, static, streets

START = GpsTime(2445, 3600.0)
HEIGHT_M = 18.0
HEIGHTS = np.full((32, 32), HEIGHT_M)
IN_THE_STREET = np.array((0.0, 40.0, 1.5))  # of a street that runs north, between two crossings
QUIET = SignalOptions(
    code_sigma_m=0.0, phase_sigma_m=0.0, rate_sigma_mps=0.0, code_multipath_m=0.0, phase_multipath_m=0.0, glonass_code_bias_m=0.0,
    slips_per_hour=0.0, half_cycle_share=0.0, fading_sigma_db=0.0,
)  # fmt: skip


def seen(place: np.ndarray, azimuth_rad: float, elevation_rad: float, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    out = np.full((1, VIEW), np.nan)
    city_view(HEIGHTS, place, np.array(velocity), np.array([azimuth_rad]), np.array([elevation_rad]), out)
    return out[0]


def test_a_knife_edge_costs_six_decibels_on_its_line_and_more_in_the_shadow():
    """The points of ITU-R P.526's curve that are known by heart, and monotony."""
    assert diffraction_db(-0.78) == 0.0
    assert diffraction_db(0.0) == pytest.approx(6.03, abs=0.01)
    assert diffraction_db(2.4) == pytest.approx(6.9 + 20.0 * np.log10(np.hypot(2.3, 1.0) + 2.3))
    losses = [diffraction_db(v) for v in np.linspace(-0.7, 5.0, 50)]
    assert np.all(np.diff(losses) > 0.0)


def test_a_roof_hides_what_stands_below_it():
    """Across the street the roof is at atan((height - antenna) / half width): far above it nothing is lost, on it 6 dB, below much."""
    roof_rad = atan((HEIGHT_M - IN_THE_STREET[2]) / STREET_HALF_WIDTH_M)
    assert seen(IN_THE_STREET, pi / 2, roof_rad + 0.2)[ATTENUATION_DB] == 0.0
    assert seen(IN_THE_STREET, pi / 2, roof_rad)[ATTENUATION_DB] == pytest.approx(6.03, abs=0.01)
    assert seen(IN_THE_STREET, 0.0, 0.3)[ATTENUATION_DB] == 0.0  # along the street
    hidden = seen(IN_THE_STREET, pi / 2, roof_rad - 0.1)
    assert hidden[ATTENUATION_DB] > 10.0


@pytest.mark.parametrize("azimuth_rad", [pi / 2, pi / 2 + 0.4, -pi / 2, -pi / 2 - 0.3])
def test_a_wall_reflects_what_the_roof_opposite_hides(azimuth_rad: float):
    """The path is longer by twice the distance of the wall, times the cosines of the angles to its normal (image method)."""
    elevation_rad = 0.85
    place = np.array((1.5, 45.0, 1.5))
    view = seen(place, azimuth_rad, elevation_rad)
    wall_m = STREET_HALF_WIDTH_M + (place[0] if sin(azimuth_rad) > 0.0 else -place[0])
    assert view[PATH] == 1.0
    assert view[EXTRA_M] == pytest.approx(2.0 * wall_m * abs(sin(azimuth_rad)) * cos(elevation_rad), abs=1e-9)


def test_the_longer_path_changes_as_its_rate_says():
    """Moving across the street, the rate is the derivative of the longer path; moving along it, there is none."""
    across, along = (2.0, 0.0, 0.0), (0.0, 7.0, 0.0)
    view = seen(IN_THE_STREET, 1.3, 0.8, across)
    moved = seen(IN_THE_STREET + 0.01 * np.array(across), 1.3, 0.8)
    assert abs(view[EXTRA_RATE_MPS]) > 1.0
    assert view[EXTRA_RATE_MPS] == pytest.approx((moved[EXTRA_M] - view[EXTRA_M]) / 0.01, abs=1e-9)
    assert seen(IN_THE_STREET, 1.3, 0.8, along)[EXTRA_RATE_MPS] == 0.0


def test_reflections_on_a_visible_signal_are_multipath():
    """Above the roof, with a wall behind: nothing longer, but errors of code and phase; the same without walls has none."""
    with_wall = seen(IN_THE_STREET, pi / 2, 1.02)
    assert (with_wall[PATH], with_wall[EXTRA_M]) == (0.0, 0.0)
    open_place = np.array((0.0, 0.0, 1.5))
    view = seen(open_place, pi / 4, 1.2)
    assert view[CODE_SIGMA_M] == 0.0


def test_the_streets_of_the_car_are_streets():
    """The trajectory of the city never leaves the roadway and stops at crossings."""
    for time_s in np.arange(0.0, 130.0, 0.5):
        east, north, _ = streets(float(time_s)).position_enu_m
        off_m = min(abs((v + BLOCK_M / 2.0) % BLOCK_M - BLOCK_M / 2.0) for v in (east, north))
        assert off_m < 1e-6
    before, after = streets(15.5).position_enu_m, streets(18.5).position_enu_m
    assert before == pytest.approx(after, abs=1e-9)


def test_trees_weaken_low_satellites_most():
    """Averaged over all azimuths the loss falls with elevation; without trees there is none."""
    azimuth = np.tile(np.linspace(0.0, 6.2, 60), 3)
    elevation = np.repeat([0.2, 0.7, 1.4], 60)
    out = np.empty((180, VIEW))
    forest(1, 0.6)(np.zeros(3), np.zeros(3), azimuth, elevation, out)
    means = out[:, ATTENUATION_DB].reshape(3, 60).mean(axis=1)
    assert means[0] > means[1] > means[2] > 0.5
    forest(1, 0.0)(np.zeros(3), np.zeros(3), azimuth, elevation, out)
    assert not out.any()


def test_the_same_city_for_the_same_seed():
    """A seed stands for one city."""
    azimuth, elevation = np.linspace(0.0, 6.2, 100), np.full(100, 0.5)
    views = np.empty((3, 100, VIEW))
    for out, seed in zip(views, (1, 1, 2), strict=True):
        city(seed, 20.0)(IN_THE_STREET, np.zeros(3), azimuth, elevation, out)
    assert np.array_equal(views[0], views[1])
    assert not np.array_equal(views[0], views[2])


# --- what a receiver makes of it ---


def receiver(view: np.ndarray, **signals: float) -> Receiver:
    """A receiver whose signals all suffer what ``view`` (VIEW) says at the time of an epoch; the caller may change it between epochs."""

    def surroundings(_offset: object, _velocity: object, _azimuth: object, _elevation: object, out: np.ndarray) -> None:
        out[:] = view

    options = ReceiverOptions(signals=QUIET._replace(**signals))
    return Receiver("a", AntennaPath(Site(0.9, 0.2, 50.0), static, (0.0, 0.0, 0.0)), 1, options, (), surroundings)


def keys(observed: Observed) -> np.ndarray:
    return observed.epoch.satellite.astype(int) * 512 + observed.epoch.signal


def test_weak_signals_show_it_and_are_lost():
    """The loss is in C/N0 one to one; signals below the receiver's threshold are gone, the same satellites come back with new arcs."""
    view = np.zeros(VIEW)
    tested, other = receiver(view), receiver(np.zeros(VIEW))
    one, two = tested.observe(START), other.observe(START)
    assert np.array_equal(one.epoch.cn0_dbhz, two.epoch.cn0_dbhz)
    view[ATTENUATION_DB] = 10.0
    one, two = tested.observe(START + 1.0), other.observe(START + 1.0)
    _, i, j = np.intersect1d(keys(one), keys(two), return_indices=True)
    assert one.epoch.cn0_dbhz[i] == pytest.approx(two.epoch.cn0_dbhz[j] - 10.0)
    assert 0 < len(i) < len(two.epoch)
    assert np.setdiff1d(keys(two), keys(one)).size > 0
    view[ATTENUATION_DB] = 60.0
    assert len(tested.observe(START + 2.0).epoch) == 0
    view[ATTENUATION_DB] = 0.0
    for k in range(3, 9):
        back = tested.observe(START + float(k))
    assert len(back.epoch) == len(other.observe(START + 8.0).epoch)
    assert back.epoch.lock_s.max() < 6.0


@pytest.mark.parametrize(("untold_share", "told"), [(0.0, True), (1.0, False)])
def test_another_way_is_longer_and_breaks_the_arc(untold_share: float, told: bool):
    """Codes grow by the longer path, phases by it and whole cycles; the receiver says so unless it does not notice."""
    view = np.zeros(VIEW)
    tested, other = receiver(view, untold_share=untold_share), receiver(np.zeros(VIEW))
    tested.observe(START)
    other.observe(START)
    view[EXTRA_M], view[PATH] = 7.25, 1.0
    one, two = tested.observe(START + 1.0).epoch, other.observe(START + 1.0).epoch
    assert one.pseudorange_m - two.pseudorange_m == pytest.approx(7.25, abs=1e-6)
    gps = (one.satellite < 64) & (one.signal == 1 * 26 + 2)
    cycles = (one.phase_cyc - two.phase_cyc)[gps] - 7.25 * 1575.42e6 / 299792458.0
    assert np.abs(cycles - np.rint(cycles)).max() < 1e-3
    assert np.abs(np.rint(cycles)).min() >= 1.0
    assert np.all(((one.flags & SLIP) != 0) == told)
    assert np.all((one.lock_s == 0.0) == told)


def test_a_rate_of_the_path_is_in_the_doppler():
    """Metres per second become Hz on every carrier, with the sign of RINEX."""
    view = np.zeros(VIEW)
    view[EXTRA_RATE_MPS] = 3.0
    one, two = receiver(view).observe(START).epoch, receiver(np.zeros(VIEW)).observe(START).epoch
    gps = (one.satellite < 64) & (one.signal == 1 * 26 + 2)
    assert (one.doppler_hz - two.doppler_hz)[gps] == pytest.approx(-3.0 * 1575.42e6 / 299792458.0, rel=1e-6)


def test_weak_signals_slip():
    """At 26 dB-Hz and 60 slips an hour at 28, every signal slips in about twenty seconds; strong signals do not."""
    view = np.zeros(VIEW)
    tested = receiver(view, weak_slips_per_hour=60.0)
    slips = [int(np.sum(tested.observe(START + float(k)).epoch.flags & SLIP)) for k in range(20)]
    assert sum(slips) < 5
    view[ATTENUATION_DB] = 14.0
    weak = [tested.observe(START + 20.0 + k).epoch for k in range(40)]
    expected = sum(float(np.sum(60.0 / 3600.0 * 10.0 ** ((28.0 - e.cn0_dbhz) / 2.5))) for e in weak)
    assert sum(int(np.sum(e.flags & SLIP)) for e in weak) == pytest.approx(expected, rel=0.35)
