"""Partial resolution: what the vectors that cannot be ruled out have in common."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.models.odds import log_odds
from rtkmesh.rtk.ambiguity import NODE_LIMIT, Candidates, search, search_pairs
from rtkmesh.rtk.common_integers import KEPT, LEAST, SIGMA_M, in_common, search_common
from rtkmesh.rtk.state import DYNAMIC, HISTORY, Filter

WAVELENGTH_M = 0.19
ASKED = 8.0
TRUE = np.array([3, -7, 12, 0, 5, 1, -2, 9, 4, -3])


def floating(rng, phase_m, code_m=0.4):
    """A filter after an epoch of ten satellites of one group whose phases have these sigmas (m)."""
    n = len(TRUE)
    azimuth, elevation = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(0.3, 1.5, n)
    sky = np.column_stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    codes, phases = np.zeros((n, DYNAMIC + n + 1)), np.zeros((n, DYNAMIC + n + 1))
    codes[:, :3] = phases[:, :3] = -sky
    codes[:, -1] = 1.0
    phases[:, DYNAMIC:-1] = WAVELENGTH_M * np.eye(n)
    truth = np.concatenate([np.zeros(DYNAMIC), TRUE, [0.0]])
    W = np.diag(np.asarray(phase_m) ** -2.0)
    N = np.diag(np.concatenate([np.full(3, 1e-4), np.ones(6), np.full(n, 1e-8), [1e-6]]))
    N += codes.T @ codes / code_m**2 + phases.T @ W @ phases
    b = codes.T @ (codes @ truth + code_m * rng.standard_normal(n)) / code_m**2
    b += phases.T @ W @ (phases @ truth + phase_m * rng.standard_normal(n))
    P = np.linalg.inv(N)
    keys = (np.arange(n) + 1) * KEYS_PER_SATELLITE
    f = Filter((P @ b)[:-1].copy(), P[:-1, :-1].copy(), keys, np.zeros((n, HISTORY)))
    return f, Candidates(np.arange(n), np.zeros(n, np.int64), np.arange(n) + 1, elevation)


@settings(deadline=None, max_examples=200)
@given(
    st.lists(st.lists(st.integers(-1, 1), min_size=7, max_size=7), min_size=0, max_size=5),
    st.lists(st.integers(0, 1), min_size=7, max_size=7),
)
def test_what_is_common_is_the_largest_set_that_moves_together(moves, groups):
    """Of each group the double differences among the largest set of ambiguities that all vectors move by equal numbers."""
    first = np.array([4.0, -2.0, 0.0, 7.0, 1.0, 3.0, -5.0])
    vectors = np.vstack([first, *(first + np.array(move) for move in moves)])
    pairs = np.array([[20 + k, 10 + group] for k, group in enumerate(groups)])
    common, integers = in_common(pairs, vectors)
    value = np.zeros((len(vectors), 30))
    value[:, 20:27] = vectors
    told = value[:, common[:, 0]] - value[:, common[:, 1]]
    assert (told == integers).all()
    for group in (0, 1):
        members = np.array([10 + group, *(state for state, reference in pairs.tolist() if reference == 10 + group)])
        _, count = np.unique((value[:, members] - value[0, members]).T, axis=0, return_counts=True)
        assert np.isin(common[:, 0], members[1:]).sum() == count.max() - 1
        assert len(set(common[np.isin(common[:, 0], members), 1].tolist())) <= 1
    assert len(set(common[:, 0].tolist())) == len(common)


def test_a_phase_that_says_nothing_does_not_hold_up_the_others():
    """With the phase of one satellite a third of a cycle unsure the search of all is not clear; what the vectors have in common is, is
    right, and places the rover.
    """
    rng, found, best = np.random.default_rng(1), 0, 0
    phase_m = np.full(len(TRUE), 0.003)
    phase_m[4] = WAVELENGTH_M / 3.0
    for _ in range(40):
        f, candidates = floating(rng, phase_m)
        common = search_common(f, candidates, ASKED)
        best += search(f, candidates, np.nan, 0.01).odds >= ASKED
        if not common.resolved:
            continue
        found += 1
        true = TRUE[common.pairs[:, 0] - DYNAMIC] - TRUE[common.pairs[:, 1] - DYNAMIC]
        assert common.integers.tolist() == true.tolist()
        assert len(common.pairs) >= LEAST
        assert common.odds >= ASKED
        places = common.pairs - DYNAMIC
        assert (common.values[places[:, 0]] - common.values[places[:, 1]] == true).all()
    assert best == 0
    assert found > 10


def test_odds_are_those_against_the_first_vector_that_is_left_out():
    """The vectors before it are those that the asked odds do not rule out."""
    rng, phase_m = np.random.default_rng(2), np.full(len(TRUE), 0.003)
    phase_m[[2, 4]] = WAVELENGTH_M / 3.0
    compared = 0
    for _ in range(20):
        f, candidates = floating(rng, phase_m)
        common = search_common(f, candidates, ASKED)
        if not common.resolved:
            continue
        n = len(TRUE) - 1
        reference = int(np.argmax(candidates.weight))
        pairs = np.array([[DYNAMIC + k, DYNAMIC + reference] for k in range(len(TRUE)) if k != reference])
        fixed, norms = np.zeros((KEPT, n)), np.zeros(KEPT)
        search_pairs(f.x, f.P, pairs, NODE_LIMIT, fixed, norms)
        odds = np.array([log_odds(norms[0], norm, n) for norm in norms])
        rival = int(np.argmax(odds >= ASKED))
        assert (common.norm, common.second) == (norms[0], norms[rival])
        assert sorted(map(tuple, common.pairs.tolist())) == sorted(map(tuple, in_common(pairs, fixed[:rival])[0].tolist()))
        compared += 1
    assert compared > 2


def test_too_little_in_common_is_nothing():
    """Four satellites, integers that all are as good, or a place that stays unknown: not resolved."""
    f, candidates = floating(np.random.default_rng(3), np.full(len(TRUE), 0.003))
    few = Candidates(*(column[:LEAST] for column in candidates))
    assert not search_common(f, few, ASKED).resolved
    noisy, candidates = floating(np.random.default_rng(3), np.full(len(TRUE), WAVELENGTH_M))
    assert not search_common(noisy, candidates, ASKED).resolved
    wide = Filter(f.x, f.P.copy(), f.keys, f.history)
    wide.P[:3, :3] += np.eye(3)
    assert SIGMA_M < 1.0
    assert not search_common(wide, candidates, 1.0).resolved
