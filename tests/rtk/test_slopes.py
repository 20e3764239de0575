"""The slopes of GLONASS phases over the channels: one a band, alike at first, found, remembered, taken away."""

from dataclasses import replace
from math import hypot

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.signals import ATTRIBUTES, GLONASS, KEYS_PER_SATELLITE, SATELLITES_PER_SYSTEM, SIGNALS_PER_SATELLITE, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.ambiguity import pairs_of
from rtkmesh.rtk.bookkeeping import Walks, begin_ambiguities, begin_shared, find_candidates, find_places, grow, wanted_keys
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.matching import Pairs
from rtkmesh.rtk.memory import SLOPE_G1, SLOPE_G2, SLOPE_SIGMA_G1, SLOPE_SIGMA_G2, SLOPE_SIGMA_M, forget, new_memory
from rtkmesh.rtk.noise import new_code_scale
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.residuals import (
    CHANNEL,
    CODE,
    CODE_VARIANCE,
    DIFFERENCE,
    ELEVATION_RAD,
    IONOSPHERE,
    PHASE,
    PHASE_VARIANCE,
    WAVELENGTH,
    Differences,
    wavelengths,
)
from rtkmesh.rtk.slopes import SLOPE_CHANGE_M, SLOPES_APART_M, begin_slope, learn_slopes, slope_states, without_slopes
from rtkmesh.rtk.solution import Status
from rtkmesh.rtk.state import (
    ARC_EPOCHS,
    DYNAMIC,
    HISTORY,
    INTEGER,
    SEEN_S,
    SLOPE_KEYS,
    USUAL_M,
    ZENITH_KEY,
    Filter,
    is_ionosphere,
    new_filter,
    place_of,
    use_keys,
)
from rtkmesh.rtk.update import Layout, update
from rtkmesh.simulation.classes import SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site

TRUE_M = 0.021, 0.0165
CHANNELS = np.array([-7, -4, -1, 2, 3, 5, 6])
BASELINE_M = np.array([12.0, -7.0, 3.0])
UNKNOWN = (0.0, SLOPE_SIGMA_M)
WALKS = Walks(0.0, 3600.0, 0.02, 0.0, 0.02, 0.5, 1e-6, (UNKNOWN, UNKNOWN))


def epoch(bands=(1, 2), order=None):
    """Return the differences of eight GPS and seven GLONASS satellites without noise, whose phases have TRUE_M, and their integers."""
    rng = np.random.default_rng(5)
    channel = np.repeat(np.concatenate([np.zeros(8), CHANNELS]), len(bands))
    number = np.repeat(np.concatenate([np.arange(1, 9), SATELLITES_PER_SYSTEM * GLONASS + np.arange(1, 8)]), len(bands))
    band, n = np.tile(bands, 15), 15 * len(bands)
    azimuth, elevation = (np.repeat(rng.uniform(low, high, 15), len(bands)) for low, high in ((0.0, 2.0 * np.pi), (0.3, 1.4)))
    towards = np.column_stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    signal, group = band * ATTRIBUTES + 2, (number // SATELLITES_PER_SYSTEM) * len(bands) + np.searchsorted(bands, band)
    integer, table = rng.integers(-20, 20, n).astype(np.float64), np.zeros((n, DIFFERENCE))
    table[:, WAVELENGTH], table[:, IONOSPHERE] = np.where(band == 1, 0.19, 0.24) * (1.0 - 3e-4 * channel), 1.0
    table[:, CODE_VARIANCE], table[:, PHASE_VARIANCE] = 0.3**2, 0.001**2
    table[:, ELEVATION_RAD], table[:, CHANNEL] = elevation, channel
    clock_m = rng.normal(size=2 * len(bands))[group]
    table[:, CODE] = clock_m - towards @ BASELINE_M
    table[:, PHASE] = table[:, CODE] + table[:, WAVELENGTH] * integer + channel * np.array(TRUE_M)[band - 1]
    key = number.astype(np.int64) * KEYS_PER_SATELLITE + signal * SIGNALS_PER_SATELLITE + signal
    order = np.arange(n) if order is None else order
    index, flags = np.arange(n), np.zeros((n, 2), np.bool_)
    like = np.zeros(n, np.int64)
    pairs = Pairs(number[order].astype(np.int16), index, index, like, group[order], 2 * len(bands), key[order])
    d = Differences(
        pairs, table[order].copy(), towards[order].copy(), towards[order].copy(), np.zeros(n), flags, flags[:, 0].copy(),
        np.zeros((n, 2)), np.zeros(n),
    )  # fmt: skip
    return d, integer[order]


def solved(d, integers):
    """Return the filter after this epoch, with its true integers held, and the pairs of these."""
    f = use_keys(new_filter(), wanted_keys(d.pairs.key, d.pairs.satellite, d.table, True, 0), 0.0, 20.0)
    np.fill_diagonal(f.P[:DYNAMIC, :DYNAMIC], 30.0**2)
    ambiguity, ionosphere, slope = (np.empty(len(integers), np.int64) for _ in range(3))
    find_places(f.keys, d.pairs.key, d.pairs.satellite, d.table, True, False, ambiguity, ionosphere, slope)
    begin_shared(f, WALKS, 0.0, ionosphere)
    begin_ambiguities(f.x, f.P, f.history, ambiguity, d.pairs.satellite, d.table, DYNAMIC, 0.0)
    one = np.ones(len(integers))
    layout = Layout(ambiguity, ionosphere, slope, -1, -1, one, one)
    nothing = np.full(3, np.nan)
    outcome = update(f, d, layout, new_code_scale(), nothing, np.full((3, 3), np.nan))
    assert outcome.ok
    assert outcome.phase_used.all()
    f.history[ambiguity, INTEGER] = integers
    return f, pairs_of(find_candidates(f, d, layout, outcome.phase_used, 0.0, -1.0))


def learned(d, integers):
    memory = new_memory()
    learn_slopes(*solved(d, integers), memory)
    return memory


def test_a_filter_that_is_fed_two_slopes_finds_both():
    """With the integers known each band's slope is its own; what is remembered of it has its sigma."""
    memory = learned(*epoch())
    assert memory[[SLOPE_G1, SLOPE_G2]] == pytest.approx(TRUE_M, abs=2e-4)
    assert (memory[[SLOPE_SIGMA_G1, SLOPE_SIGMA_G2]] < 0.0012).all()
    forget(memory)
    assert memory[[SLOPE_G1, SLOPE_G2]] == pytest.approx(TRUE_M, abs=2e-4)


@pytest.mark.slow  # without compilation; with it, seconds
def test_an_engine_finds_the_slopes_of_simulated_receivers():
    """The base's phases are late by two slopes: so the differences to it are early."""
    start, site = GpsTime(2445, 100000.0), Site(0.82, 0.14, 400.0)
    quiet = SURVEY.signals._replace(phase_multipath_m=2e-4)
    base_options = replace(SURVEY, steered=True, signals=quiet._replace(glonass_slopes_m=TRUE_M))
    rover = Receiver("rover", AntennaPath(site, None, (0.0, 0.0, -1.5)), 5, replace(SURVEY, signals=quiet))
    base = Receiver("base", AntennaPath(site, None, (-320.0, 210.0, 4.0)), 5, base_options)
    engine, table = Rtk(RtkOptions(systems="GRE", frequencies=2)), EphemerisTable()
    for number in SATELLITES.tolist():
        table.add(broadcast(number, start))
    for k in range(20):
        pair = [end.observe(start + float(k)) for end in (rover, base)]
        last = engine.step(pair[0].epoch, pair[1].epoch, table, KLOBUCHAR, base_position_ecef_m=pair[1].position_ecef_m)
    assert last.status is Status.FIX
    assert last.glonass_slopes_m == pytest.approx((-TRUE_M[0], -TRUE_M[1]), abs=1e-3)


@given(st.randoms(use_true_random=False))
def test_the_order_of_satellites_does_not_matter(random):
    order = list(range(30))
    random.shuffle(order)
    assert learned(*epoch(order=np.array(order))) == pytest.approx(learned(*epoch()), abs=1e-8)


@pytest.mark.parametrize("band", [1, 2])
def test_one_band_has_one_state_and_its_slope_goes_for_the_other_until_that_is_known(band):
    d, integers = epoch(bands=(band,))
    f, held = solved(d, integers)
    assert [key for key in f.keys if key in SLOPE_KEYS] == [SLOPE_KEYS[band - 1]]
    assert len(f.keys) == len(integers) + 1
    memory = new_memory()
    learn_slopes(f, held, memory)
    own, other = SLOPE_G1 + band - 1, SLOPE_G2 - band + 1
    assert memory[[own, other]] == pytest.approx(TRUE_M[band - 1], abs=1e-4)
    assert memory[SLOPE_SIGMA_G1 + other - SLOPE_G1] == hypot(memory[SLOPE_SIGMA_G1 + own - SLOPE_G1], SLOPES_APART_M)
    memory[other], memory[SLOPE_SIGMA_G1 + other - SLOPE_G1] = -0.004, SLOPE_CHANGE_M
    learn_slopes(f, held, memory)
    assert memory[other] == -0.004


def shared_filter(keys, seed=1):
    """Return a filter of these keys that knows something, none of its states new."""
    n = DYNAMIC + len(keys)
    A = np.random.default_rng(seed).normal(size=(n, n))
    history = np.zeros((len(keys), HISTORY))
    history[:, USUAL_M] = 0.02
    return Filter(np.random.default_rng(seed + 1).normal(size=n), A @ A.T + np.eye(n), np.array(keys, np.int64), history)


@given(st.booleans())
def test_a_new_slope_is_like_that_of_the_other_band(second):
    """It has the other's value and covariances, and of its own the variance of what they differ by."""
    f = shared_filter([ZENITH_KEY, *SLOPE_KEYS, KEYS_PER_SATELLITE])
    row, old = (2, DYNAMIC + 1) if second else (1, DYNAMIC + 2)
    f.history[row, ARC_EPOCHS] = -1.0
    begin_slope(f, row, (UNKNOWN, UNKNOWN))
    new, rest = DYNAMIC + row, np.arange(len(f.x)) != DYNAMIC + row
    assert f.x[new] == f.x[old]
    assert (f.P[new, rest] == f.P[old, rest]).all()
    assert (f.P == f.P.T).all()
    assert f.P[new, new] == f.P[old, old] + SLOPES_APART_M**2
    assert np.linalg.eigvalsh(f.P)[0] > 0.0


@pytest.mark.parametrize("known", [True, False], ids=["learned", "the other is new too"])
def test_a_new_slope_is_what_was_learned_of_its_band(known):
    f = shared_filter(SLOPE_KEYS)
    f.history[:, ARC_EPOCHS] = 0.0 if known else -1.0
    begin_slope(f, 1, ((0.01, 1e-3), (-0.02, 1e-3 if known else SLOPE_SIGMA_M)))
    i = DYNAMIC + 1
    assert f.x[i] == -0.02
    assert f.P[i, i] == (1e-3 if known else SLOPE_SIGMA_M) ** 2
    assert np.count_nonzero(f.P[i]) == 1


@pytest.mark.parametrize("keys", [SLOPE_KEYS, SLOPE_KEYS[:1], SLOPE_KEYS[1:], ()], ids=["both", "G1", "G2", "none"])
def test_without_slopes_is_the_filter_given_that_they_are_nothing(keys):
    f = shared_filter([ZENITH_KEY, 3, *keys, KEYS_PER_SATELLITE, 2 * KEYS_PER_SATELLITE])
    flat, sloped = without_slopes(f), slope_states(f)
    rest = np.setdiff1d(np.arange(len(f.x)), sloped)
    gain = np.linalg.solve(f.P[np.ix_(sloped, sloped)], f.P[sloped]).T
    assert flat.x[rest] == pytest.approx((f.x - gain @ f.x[sloped])[rest], rel=1e-9)
    assert flat.P[np.ix_(rest, rest)] == pytest.approx((f.P - gain @ f.P[sloped])[np.ix_(rest, rest)], rel=1e-9, abs=1e-9)
    assert (flat.x[sloped] == 0.0).all()
    assert flat.P[np.ix_(sloped, sloped)] == pytest.approx(np.eye(len(sloped)) * SLOPE_CHANGE_M**2)
    assert (flat.P[np.ix_(sloped, rest)] == 0.0).all()


def test_slopes_walk_on_their_own():
    """Each gets its own walk; ionospheres beside them none."""
    f = shared_filter([ZENITH_KEY, 3, *SLOPE_KEYS, KEYS_PER_SATELLITE])
    before = np.diag(f.P).copy()
    grow(f.P, f.keys, DYNAMIC, WALKS._replace(zenith_m=0.5, ambiguity_cyc=2.0, slope_m=1.0), 4.0)
    assert (np.diag(f.P) - before)[DYNAMIC:] == pytest.approx([1.0, 0.0, 4.0, 4.0, 16.0])
    assert [is_ionosphere(int(key)) for key in f.keys] == [False, True, False, False, False]


def test_slopes_outlive_a_gap_of_their_satellites():
    """Seen or not, what is known of receivers stays in the filter."""
    d, integers = epoch()
    f, _ = solved(d, integers)
    begin_shared(f, WALKS, 100.0, np.zeros(0, np.int64))
    assert (f.history[[place_of(f.keys, key) for key in SLOPE_KEYS], SEEN_S] == 100.0).all()


def test_signals_without_channels_have_no_slope():
    """G3 and L1OC are of one frequency for all satellites; a satellite of channel 0 has a slope of nothing."""
    codes = ("1C", "2P", "3Q", "4A", "6A", "1C")
    satellite = np.full(len(codes), GLONASS * SATELLITES_PER_SYSTEM + 1, np.int16)
    satellite[-1] = 5  # GPS
    signal, channel = np.array([signal_number(code) for code in codes], np.int16), np.full(len(codes), -4, np.int8)
    wavelength_m, channels = np.empty(len(codes)), np.empty(len(codes))
    wavelengths(satellite, signal, channel, np.arange(len(codes)), np.zeros(448, np.int8), wavelength_m, channels)
    assert channels.tolist() == [-4.0, -4.0, 0.0, 0.0, 0.0, 0.0]
    assert np.isfinite(wavelength_m).all()
