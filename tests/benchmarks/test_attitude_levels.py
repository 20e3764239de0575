"""Protection levels on the simulated boat: moving bases of real observations, with faults of antennas put in."""

from types import SimpleNamespace

import numpy as np

NAMES = ("attitude",)


def test_faults_that_pass_the_tests_stay_within_the_levels(benchmarks: SimpleNamespace) -> None:
    """5 to 50 mm on one antenna: many of the attitudes that pass are beyond their sigmas, none beyond its levels; nor is a clean one."""
    b = benchmarks.attitude
    scores, faults = {count: b.Score() for count in (2, 3, 4)}, {}
    b.run(np.random.default_rng(0), 120, scores, faults)
    passed = sum(score.passed for score in faults.values())
    assert passed > 90
    assert sum(score.beyond_sigmas for score in faults.values()) > 0.06 * passed  # 21 of 175
    assert [key for key, score in faults.items() if score.beyond_levels] == []
    assert [score.beyond for score in scores.values()] == [0, 0, 0]
    two, three, four = (score.row(count)["levels_deg"] for count, score in scores.items())
    assert (two[0], np.isnan(two[2])) == (np.inf, True)
    assert max(four) < 2.0 < 20.0 < min(three[1:])
