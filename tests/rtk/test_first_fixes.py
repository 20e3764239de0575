"""First fixes: which log odds are asked, and what GLONASS says of the others' integers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.rtk.float_filters import GPS, TRUE, floating

from rtkmesh.models.odds import log_odds
from rtkmesh.rtk.acceptance import (
    AGAINST_LEAST,
    AGREES,
    ALL_LEAST,
    NO_SLOPE_FIT,
    OBJECTS,
    OPEN_SLOPE_FEW,
    OPEN_SLOPE_LEAST,
    SILENT,
    bears_out,
    glonass_says,
    is_borne_out,
    log_space,
)
from rtkmesh.rtk.ambiguity import NODE_LIMIT, Candidates, pairs_of, search, search_pairs, take
from rtkmesh.rtk.asked_odds import (
    ASKED_OF_SCANT,
    ASKED_OF_STREETS,
    ASKED_OF_SURVEY_CODES,
    ASKED_OF_WITNESSED,
    ATMOSPHERE_FROM_M,
    FAIR_CODES,
    SCANT_COUNT,
    STREET_CODES,
    SURVEY_CODES,
    WEAK_COUNT,
    asked_odds,
    code_level,
    is_felt,
    is_street,
    odds_of_lasting,
)
from rtkmesh.rtk.memory import ACCEPT_AFTER_STREAK, ACCEPT_AT_ONCE, new_memory, resolve_setup
from rtkmesh.rtk.noise import learn_codes, new_code_scale
from rtkmesh.rtk.options import AmbiguityOptions
from rtkmesh.rtk.slopes import without_slopes
from rtkmesh.rtk.state import DYNAMIC, HISTORY, INTEGER, SLOPE_KEYS, ZENITH_KEY, Filter, filter_at
from rtkmesh.rtk.trust import RIVALS, search_wide
from rtkmesh.rtk.validation import decide, is_clear
from rtkmesh.rtk.witness import LEAST, has_witness, witnessed


@pytest.mark.parametrize("gps", [GPS, LEAST])
def test_odds_are_those_against_other_integers_of_the_others(gps):
    """Of the vectors that a longer search gives, the first with other GPS integers counts; the best one's GPS integers are told."""
    rng, compared = np.random.default_rng(1), 0
    for _ in range(12):
        f, everything = floating(rng, gps=gps)
        assert has_witness(f, everything) == (gps > LEAST)
        if gps == LEAST:
            continue  # six satellites are five differences
        pairs, told = pairs_of(everything), witnessed(f, search_wide(f, everything, SETUP))
        fixed, norms = np.zeros((2 * RIVALS, len(pairs))), np.zeros(2 * RIVALS)
        search_pairs(f.x, f.P, pairs, NODE_LIMIT, fixed, norms)
        own = pairs[:, 0] <= DYNAMIC + gps
        assert told.pairs.tolist() == pairs[own].tolist()
        assert told.integers.tolist() == fixed[0, own].tolist()
        rivals = np.flatnonzero((fixed[:, own] != fixed[0, own]).any(axis=1))
        rival = min(rivals[0], RIVALS - 1) if len(rivals) else RIVALS - 1
        assert told.odds == pytest.approx(log_odds(norms[0], norms[rival], len(pairs)), rel=1e-9)
        compared += rival > 1
    assert gps == LEAST or compared > 2  # runners-up that differ in GLONASS alone are common


def test_a_witness_helps_and_does_not_mislead():
    """With the slope unknown GLONASS makes right integers clear where GPS alone and both together do not, and wrong ones hardly ever."""
    rng, clear, wrong = np.random.default_rng(2), np.zeros(3, np.int64), 0
    for _ in range(60):
        f, everything = floating(rng)
        alone = Candidates(*(column[:GPS] for column in everything))
        told = witnessed(f, search_wide(f, everything, SETUP))
        searches = (search(f, alone, np.nan, 0.01), search(f, everything, np.nan, 0.01), told)
        clear += [s.odds >= ASKED_OF_WITNESSED for s in searches]
        true = TRUE[told.pairs[:, 0] - DYNAMIC - 1] - TRUE[told.pairs[:, 1] - DYNAMIC - 1]
        wrong += int(told.odds >= ASKED_OF_WITNESSED and (told.integers != true).any())
    assert clear[2] > 1.5 * max(clear[0], clear[1])
    assert wrong == 0


@pytest.mark.parametrize("level", [1.0, FAIR_CODES + 0.1, np.inf])
def test_an_epoch_by_itself_is_as_clear_as_what_is_decided_by(level):
    """A look without the past goes no further where its odds, with a witness or without one, are not those that are asked of it."""
    rng, setup, helped = np.random.default_rng(4), resolve_setup(AmbiguityOptions(), None, 0.01), 0
    for _ in range(12):
        f, everything = floating(rng)
        f.history[:, INTEGER] = np.nan
        alone = Candidates(*(column[:GPS] for column in everything))
        copy = Filter(*(part.copy() for part in f))
        odds = decide(copy, everything, new_memory(), setup, np.full(7, np.nan), 0.0, level).odds
        assert is_clear(f, everything, new_memory(), setup, level, odds)
        assert not is_clear(f, everything, new_memory(), setup, level, np.nextafter(odds, np.inf))
        helped += odds > search(f, alone, np.nan, 0.01).odds
    assert (helped > 0) == (level <= FAIR_CODES)


def with_two_slopes(f: Filter) -> Filter:
    """Return the filter with a slope on the second band too, of which nothing is known."""
    kept = np.delete(np.arange(len(f.x) + 1), DYNAMIC + 1)
    x, P, history = np.zeros(len(f.x) + 1), np.eye(len(f.x) + 1), np.zeros((len(f.keys) + 1, HISTORY))
    x[kept], P[np.ix_(kept, kept)] = f.x, f.P
    return Filter(x, P, np.insert(f.keys, 1, SLOPE_KEYS[1]), history)


@pytest.mark.parametrize(("gps", "least"), [(LEAST + 1, OPEN_SLOPE_LEAST), (LEAST, OPEN_SLOPE_FEW)])
def test_no_slope_is_believed_only_where_an_open_one_gives_the_same_others(gps, least):
    f, everything = floating(np.random.default_rng(3), gps=gps)
    straight = search(without_slopes(f), everything, np.nan, 0.01)
    others, glonass = straight.integers.copy(), straight.integers.copy()
    others[gps - 2] += 1.0
    glonass[gps - 1] += 1.0
    enough, far = straight._replace(odds=least), np.zeros(len(f.x))
    far[:3] = 12e3, -16e3, 0.0
    assert bears_out(f, enough, straight)
    assert bears_out(f, enough._replace(integers=glonass), straight)
    assert not bears_out(f, enough._replace(integers=others), straight)
    assert not bears_out(f, enough._replace(odds=least - 0.01), straight)
    assert not bears_out(f, enough._replace(resolved=False), straight)
    assert not bears_out(f, enough, straight._replace(resolved=False))
    for norm, scale in ((0.5, 1.0), (3.0, 3.0)):  # of each integer: variances may be too small, but are not too large
        sloped = enough._replace(norm=norm * len(enough.pairs))
        assert bears_out(f, sloped, straight._replace(norm=sloped.norm + 0.99 * scale * NO_SLOPE_FIT))
        worse = straight._replace(norm=sloped.norm + 1.01 * scale * NO_SLOPE_FIT)
        assert not bears_out(f, sloped, worse)
        assert bears_out(f._replace(x=f.x + far), sloped, worse)  # over 20 km
        two = sloped._replace(pairs=sloped.pairs + 1), worse._replace(pairs=worse.pairs + 1)
        assert bears_out(with_two_slopes(f), *two)  # each of them may make a fit better by chance


def test_what_is_asked_follows_the_codes():
    """Nothing known: fair codes; residuals of survey antennas and of streets move it; far away what is asked anywhere is asked."""
    scale, here = new_code_scale(), np.zeros(12)
    assert code_level(scale) == 1.0
    assert asked_odds(code_level(scale), False, here) == ACCEPT_AT_ONCE
    assert asked_odds(code_level(scale), True, here) == ASKED_OF_WITNESSED
    trial = np.zeros((2, scale.shape[1]))
    trial[:, 0] = 0.05 * 20.0, 20.0
    learn_codes(scale, trial)
    assert code_level(scale) == pytest.approx(4.0 / 23.0)
    assert asked_odds(code_level(scale), False, here) == asked_odds(code_level(scale), True, here) == ASKED_OF_SURVEY_CODES
    trial[:, 2] = 6.0 * 20.0, 20.0
    learn_codes(scale, trial)
    assert code_level(scale) > FAIR_CODES
    assert asked_odds(code_level(scale), True, here) == ACCEPT_AT_ONCE
    assert asked_odds(0.1, False, np.array([0.6e3, 0.8e3, 0.0])) == pytest.approx(1.1 * ASKED_OF_SURVEY_CODES)
    assert asked_odds(0.1, False, np.array([6e3, 8e3, 0.0])) == ACCEPT_AT_ONCE
    trial[:, 1] = 9.0 * 50.0, 50.0
    learn_codes(scale, trial)
    assert is_street(code_level(scale))
    assert asked_odds(code_level(scale), True, here) == ASKED_OF_STREETS
    assert asked_odds(STREET_CODES, False, here) == asked_odds(np.inf, False, here) == ACCEPT_AT_ONCE


@settings(deadline=None)
@given(st.floats(0.02, 30.0), st.booleans(), st.floats(0.0, 50e3), st.floats(1.0, 2.0), st.floats(0.0, 10e3))
def test_worse_codes_and_longer_baselines_never_ask_for_less(level, told, length_m, worse, further_m):
    """Monotonous in both, never more than what one search must have in streets, nor elsewhere than what it must have at once."""
    near, far = np.array([0.0, length_m, 0.0]), np.array([0.0, length_m + further_m, 0.0])
    asked = asked_odds(level, told, near)
    assert ASKED_OF_SURVEY_CODES <= asked <= ASKED_OF_STREETS
    assert asked <= ACCEPT_AT_ONCE or level > STREET_CODES
    assert asked_odds(level * worse, told, near) >= asked
    assert asked_odds(level, told, far) >= asked


SETUP = resolve_setup(AmbiguityOptions(), None, 0.01)


def but_one(found, k):
    """The search as if it had found another integer of one double difference."""
    values = found.values.copy()
    values[found.pairs[k, 0] - DYNAMIC] += 1.0
    return found._replace(values=values)


def test_glonass_objects_to_integers_that_the_search_of_all_does_not_give():
    """If that is clear; it agrees with its own where they are clearer; it says nothing where it cannot be searched."""
    rng, counts = np.random.default_rng(4), np.zeros(3, np.int64)
    for _ in range(60):
        sloped, everything = floating(rng)
        f = without_slopes(sloped)  # so that it is clear at times
        told, gps = search(f, everything, np.nan, 0.01), take(everything, everything.group == 0)
        alone, clear = search(f, gps, np.nan, 0.01), told.odds >= AGAINST_LEAST
        same = bool((alone.integers == told.integers[: len(alone.pairs)]).all())
        agreed = AGREES if told.odds >= ALL_LEAST else SILENT
        assert glonass_says(f, everything, told, SETUP) == agreed
        assert glonass_says(f, everything, but_one(told, 2), SETUP) == (OBJECTS if clear else SILENT)
        assert glonass_says(f, everything, alone, SETUP) == (agreed if same else OBJECTS if clear else SILENT)
        assert glonass_says(f, take(everything, everything.group > 1), told, SETUP) == SILENT
        counts[glonass_says(f, everything, alone, SETUP)] += 1
    assert counts.min() > 0


@pytest.mark.parametrize("left_out", [0, 3])
def test_a_subset_is_borne_out_by_the_search_of_all(left_out):
    """Whichever satellite is left out, the reference of the others too; by the same integers, and odds of its own."""
    f, everything = floating(np.random.default_rng(5))
    gps = take(everything, everything.group == 0)
    by_height = np.argsort(-gps.weight)
    found = search(f, gps, np.nan, 0.01)
    subset = search(f, take(gps, np.arange(GPS) != by_height[left_out]), np.nan, 0.01)
    assert len(subset.pairs) == GPS - 2
    assert is_borne_out(f, subset, found, ALL_LEAST, SETUP)
    assert not is_borne_out(f, subset, found, ALL_LEAST - 0.01, SETUP)
    assert not is_borne_out(f, subset, found._replace(resolved=False), ALL_LEAST, SETUP)
    assert not is_borne_out(f, but_one(subset, 1), found, ALL_LEAST, SETUP)


@pytest.mark.parametrize("scant", [True, False])
def test_scant_integers_are_not_believed_by_codes_that_only_seem_good(scant):
    """With the odds that are enough where codes are good they are held from SCANT_COUNT on, fewer with those that they must have."""
    rng, gps, counts = np.random.default_rng(7), SCANT_COUNT + (0 if scant else 1), np.zeros(2, np.int64)
    for _ in range(2000):
        f, everything = floating(rng, code_m=rng.uniform(0.1, 0.8), gps=gps, channels=np.zeros(0))
        found = search(f, everything, np.nan, 0.01)
        if found.odds < ASKED_OF_SURVEY_CODES + 0.01 or found.norm > len(found.pairs) or log_space(f) > 0.0:
            continue
        f.history[:, INTEGER] = np.nan
        enough = found.odds >= ASKED_OF_SCANT
        decide(f, everything, new_memory(), SETUP, np.full(7, np.nan), 0.0, 0.9 * SURVEY_CODES)
        assert np.isfinite(f.history[:, INTEGER]).any() == (enough or not scant)
        counts[int(enough)] += 1
    assert counts.min() > 10


def test_what_must_last_is_surer_over_a_distance_whose_atmosphere_is_no_state():
    """Few integers, on one band nearer than 10 km; where the atmosphere is a state the search knows of it, and near by it is not felt."""
    few = WEAK_COUNT - 1
    for length_m, asked in (
        (0.0, 1.0),
        (ATMOSPHERE_FROM_M, 1.0),
        (ATMOSPHERE_FROM_M + 1.0, 1.4),
        (9e3, ACCEPT_AT_ONCE / ACCEPT_AFTER_STREAK),
    ):
        f = filter_at(np.array([0.0, length_m, 0.0]), np.ones(3))
        assert is_felt(f) is (length_m > ATMOSPHERE_FROM_M)
        assert odds_of_lasting(f, few) == pytest.approx(asked * ACCEPT_AFTER_STREAK, rel=1e-3)
        assert odds_of_lasting(f, WEAK_COUNT) == ACCEPT_AFTER_STREAK
        calm = Filter(np.append(f.x, 0.0), np.eye(DYNAMIC + 1), np.array([ZENITH_KEY]), np.zeros((1, HISTORY)))
        assert odds_of_lasting(calm, few) == ACCEPT_AFTER_STREAK
