"""The numerical example of Blanch et al. 2012, Advanced RAIM User Algorithm Description, ION GNSS 2012 (appendix): ten satellites of two
constellations, their variances for integrity and for accuracy, and the standard deviations that follow for the vertical.
"""

import numpy as np
import pytest

from rtkmesh.rtk.separation import CLOCK, COLUMNS, RANGE, Ranges, solve_epoch

GEOMETRY = np.array([
    [0.0225, 0.9951, -0.0966], [0.6750, -0.6900, -0.2612], [0.0723, -0.6601, -0.7477], [-0.9398, 0.2553, -0.2269],
    [-0.5907, -0.7539, -0.2877], [-0.3236, -0.0354, -0.9455], [-0.6748, 0.4356, -0.5957], [0.0938, -0.7004, -0.7075],
    [0.5571, 0.3088, -0.7709], [0.6622, 0.6958, -0.2780],
])  # fmt: skip
INTEGRITY_M2 = np.array([3.8865, 1.4377, 0.8604, 1.6383, 1.3229, 0.8434, 0.8963, 0.8669, 0.8573, 1.3616])
ACCURACY_M2 = np.array([3.5740, 1.1252, 0.5479, 1.3258, 1.0104, 0.5309, 0.5838, 0.5544, 0.5448, 1.0491])
BIAS_M = 0.5
FIRST = np.arange(10) < 5  # the first constellation


def ranges_of(used: np.ndarray, value_m: np.ndarray) -> Ranges:
    rows = np.ones((10, COLUMNS))
    rows[:, :3], rows[:, RANGE], rows[:, CLOCK] = GEOMETRY, value_m, 1.0
    return Ranges(rows, np.where(used, 1.0 / INTEGRITY_M2, 0.0), (~FIRST).astype(np.int64), np.arange(10, dtype=np.int16), 2)


def vertical_gains(used: np.ndarray) -> np.ndarray:
    """What a metre of each range does to the height."""
    return np.array([solve_epoch(ranges_of(used, unit)).place[2] for unit in np.eye(10)])


@pytest.mark.parametrize(("used", "sigma_m", "separation_m", "bias_m"), [(FIRST, 2.5577, 1.5292, 2.0875), (~FIRST, 2.5760, 1.5307, 2.8935)])
def test_solutions_of_one_constellation(used: np.ndarray, sigma_m: float, separation_m: float, bias_m: float):
    """Their vertical sigma, what nominal biases add, and the sigma (for continuity) of their separation from the solution of all."""
    found = solve_epoch(ranges_of(used, np.zeros(10)))
    gains, all_gains = vertical_gains(used), vertical_gains(np.ones(10, np.bool_))
    assert np.sqrt(found.cov[2, 2]) == pytest.approx(sigma_m, abs=1e-3)
    assert BIAS_M * np.abs(gains).sum() == pytest.approx(bias_m, abs=1e-3)
    assert np.sqrt((gains - all_gains) ** 2 @ ACCURACY_M2) == pytest.approx(separation_m, abs=1e-3)


def test_the_accuracy_of_the_solution_of_all():
    """1.47 m in the vertical (its equation 27)."""
    assert np.sqrt(vertical_gains(np.ones(10, np.bool_)) ** 2 @ ACCURACY_M2) == pytest.approx(1.47, abs=5e-3)
