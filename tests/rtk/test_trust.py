"""From when on GLONASS is trusted: rivals that are a wavelength of slope away, votes, and what is told of the slopes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.rtk.float_filters import GPS, SLOPE_SIGMA_M, TRUE, WAVELENGTH_M, floating

from rtkmesh.rtk.ambiguity import Candidates, pairs_of, search
from rtkmesh.rtk.filter import take_value
from rtkmesh.rtk.memory import ACCEPT_AT_ONCE, GLONASS_VOTES, SLOPE_G1, TRUSTS_GLONASS, new_memory, resolve_setup
from rtkmesh.rtk.options import AmbiguityOptions
from rtkmesh.rtk.slopes import slope_states
from rtkmesh.rtk.state import DYNAMIC, INTEGER, Filter
from rtkmesh.rtk.trust import (
    STEEPEST_M,
    TOLD_SIGMA_M,
    TRUSTED_AFTER,
    found_slopes,
    learn_glonass,
    not_searched,
    possible,
    search_wide,
    tell_slopes,
)

U_BLOX_TO_LEICA_M = -0.054  # the steepest slope that we have recorded


SETUP = resolve_setup(AmbiguityOptions(), None, 0.01)
CHANNELS = np.array([-7.0, -4.0, 1.0, 2.0, 5.0])


def with_gps_held(rng, slope_m=U_BLOX_TO_LEICA_M, channels=CHANNELS):
    """A float filter whose GPS integers are held, all candidates, and the pairs of what is held and of GLONASS."""
    f, everything = floating(rng, slope_m=slope_m, channels=channels)
    f.history[:, INTEGER] = np.nan
    f.history[1 : GPS + 1, INTEGER] = TRUE[:GPS]
    gps, glonass = (Candidates(*(column[part] for column in everything)) for part in (slice(0, GPS), slice(GPS, None)))
    return f, everything, pairs_of(gps), pairs_of(glonass)


def integers_of(pairs):
    return (TRUE[pairs[:, 0] - DYNAMIC - 1] - TRUE[pairs[:, 1] - DYNAMIC - 1]).astype(np.float64)


@settings(max_examples=25)
@given(st.floats(-0.09, 0.09), st.integers(0, 1000))
def test_what_is_held_finds_any_slope_that_receivers_have(slope_m, seed):
    f, _, held, pairs = with_gps_held(np.random.default_rng(seed), slope_m)
    slopes_m, odds = found_slopes(f, pairs, slope_states(f), held)
    if odds >= ACCEPT_AT_ONCE:
        assert slopes_m[0] == pytest.approx(slope_m, abs=0.004)


def test_a_slope_a_wavelength_steeper_is_no_rival():
    """Integers that go with the channel make a vector as good as the best but for the slope's size: of it no other odds come."""
    clear, surer = 0, 0
    for seed in range(20):
        f, everything, held, pairs = with_gps_held(np.random.default_rng(seed))
        clear += found_slopes(f, pairs, slope_states(f), held)[1] >= ACCEPT_AT_ONCE
        sloped, wide = search(f, everything, np.nan, 0.01), search_wide(f, everything, SETUP)
        assert (wide.found.norm, wide.found.second, wide.found.odds) == (sloped.norm, sloped.second, sloped.odds)
        told = possible(f, wide)
        surer += told.odds > sloped.odds
        assert told.odds >= sloped.odds
        assert told.integers.tolist() == sloped.integers.tolist()
    assert clear >= 18
    assert surer >= 5


def test_channels_three_apart_leave_slopes_that_may_be():
    """Then slopes a third of a wavelength apart are alike: what is held cannot tell them, and nothing is believed."""
    for seed in range(10):
        f, _, held, pairs = with_gps_held(np.random.default_rng(seed), channels=np.array([-7.0, -4.0, -1.0, 2.0, 5.0]))
        assert found_slopes(f, pairs, slope_states(f), held)[1] < ACCEPT_AT_ONCE


def test_a_slope_that_no_receivers_have_is_never_found():
    """Half a wavelength and more may be another slope, less a wavelength: nothing is believed of it, whatever the odds."""
    for seed in range(10):
        f, everything, held, pairs = with_gps_held(np.random.default_rng(seed), slope_m=0.14)
        take_value(f.x, f.P, DYNAMIC, 0.14, 0.002**2)
        assert found_slopes(f, pairs, slope_states(f), held)[1] == -np.inf
        wide = search_wide(f, everything, SETUP)
        assert possible(f, wide).odds == wide.found.odds


def trusted_after(f, everything, held, memory, epochs, made=False):
    """Return whether GLONASS is trusted after some epochs, in which the search of all had been ``made`` or not."""
    for _ in range(epochs):
        learn_glonass(f, everything, search_wide(f, everything, SETUP) if made else not_searched(f), held, memory, SETUP)
    return memory[TRUSTS_GLONASS] > 0.0


def test_trust_takes_some_epochs_and_tells_the_slope():
    f, everything, held, _ = with_gps_held(np.random.default_rng(1))
    memory = new_memory()
    assert not trusted_after(f, everything, held, memory, TRUSTED_AFTER - 1)
    assert np.sqrt(f.P[DYNAMIC, DYNAMIC]) > 0.5 * SLOPE_SIGMA_M
    assert trusted_after(f, everything, held, memory, 1)
    assert f.x[DYNAMIC] == pytest.approx(U_BLOX_TO_LEICA_M, abs=TOLD_SIGMA_M)
    assert np.sqrt(f.P[DYNAMIC, DYNAMIC]) <= TOLD_SIGMA_M
    assert np.linalg.eigvalsh(f.P).min() > 0.0


def test_an_epoch_that_does_not_fit_begins_the_count_anew():
    f, everything, held, _ = with_gps_held(np.random.default_rng(1))
    memory = new_memory()
    trusted_after(f, everything, held, memory, TRUSTED_AFTER - 1)
    reflected = Filter(f.x.copy(), f.P, f.keys, f.history)
    reflected.x[DYNAMIC + 1 + GPS :] += 0.3 * np.array([1.0, -1.0, 1.0, 1.0, -1.0])
    learn_glonass(reflected, everything, not_searched(reflected), held, memory, SETUP)
    assert memory[GLONASS_VOTES] == 0.0
    assert not trusted_after(f, everything, held, memory, TRUSTED_AFTER - 1)


@pytest.mark.parametrize("made", [False, True])
def test_wrong_integers_of_the_others_are_no_reason_to_trust(made):
    """One GPS satellite a cycle off: GLONASS does not fit then, by a search that was made before or is now."""
    believed = 0
    for seed in range(20):
        f, everything, held, _ = with_gps_held(np.random.default_rng(seed))
        f.history[held[seed % len(held), 0] - DYNAMIC, INTEGER] += 1.0
        believed += trusted_after(f, everything, held, new_memory(), TRUSTED_AFTER, made)
    assert believed == 0


def test_once_trusted_the_slope_of_held_integers_is_remembered():
    f, everything, _, _ = with_gps_held(np.random.default_rng(1))
    f.history[GPS + 1 :, INTEGER] = TRUE[GPS:]
    memory = new_memory()
    memory[TRUSTS_GLONASS] = 1.0
    learn_glonass(f, everything, not_searched(f), pairs_of(everything), memory, SETUP)
    assert memory[SLOPE_G1] == pytest.approx(U_BLOX_TO_LEICA_M, abs=0.002)


def test_two_satellites_of_glonass_are_not_asked():
    f, everything, held, _ = with_gps_held(np.random.default_rng(1))
    few, memory = Candidates(*(column[: GPS + 2] for column in everything)), new_memory()
    assert not trusted_after(f, few, held, memory, TRUSTED_AFTER)
    assert memory[GLONASS_VOTES] == 0.0


def test_a_slope_that_is_told_leaves_only_its_own_integers():
    """Told with a twentieth of a cycle, the search that had rivals a wavelength away has none."""
    f, everything, _, _ = with_gps_held(np.random.default_rng(1))
    pairs = pairs_of(everything)
    before = search(f, everything, np.nan, 0.01)
    tell_slopes(f, pairs, integers_of(pairs))
    after = search(f, everything, np.nan, 0.01)
    assert after.integers.tolist() == integers_of(pairs).tolist()
    assert after.odds > before.odds
    assert f.x[DYNAMIC] == pytest.approx(U_BLOX_TO_LEICA_M, abs=TOLD_SIGMA_M)


def test_of_slopes_a_wavelength_apart_one_may_be():
    assert 0.5 * WAVELENGTH_M < STEEPEST_M < 0.75 * WAVELENGTH_M
