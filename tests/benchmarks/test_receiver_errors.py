"""What is measured of receivers' errors: known errors are found again, and the simulated classes have those of their recordings."""

from types import SimpleNamespace

import numpy as np
import pytest

from rtkmesh.simulation.classes import M8, SURVEY

NAMES = ("error_series", "pair_errors", "code_minus_phase")


def test_size_and_memory_of_known_errors_are_found(benchmarks: SimpleNamespace) -> None:
    """A white and a first-order part, of 0.6 and 0.8 m at 20 degrees and half of that at 40: correlations 0.64 exp(-lag / 20 s)."""
    rng, count, found = np.random.default_rng(1), 600, benchmarks.error_series.Collected()
    for key in range(40):
        wander, low = rng.standard_normal(), key % 2 == 0
        for k in range(count):
            wander = np.exp(-1.0 / 20.0) * wander + np.sqrt(1.0 - np.exp(-0.1)) * rng.standard_normal()
            error_m = (1.0 if low else 0.5) * (0.6 * rng.standard_normal() + 0.8 * wander)
            found.add(float(k), [key], np.radians([20.0 if low else 40.0]), np.array([error_m]))
    described = benchmarks.error_series.describe(found.series())
    assert described.sigma_m[:2] == pytest.approx((1.0, 0.5), rel=0.05)
    assert np.isnan(described.sigma_m[2])
    expected = [0.64 * np.exp(-lag_s / 20.0) for lag_s in benchmarks.error_series.LAGS_S]
    assert described.correlation == pytest.approx(expected, abs=0.06)


def test_simulated_receivers_have_the_errors_of_the_recorded_ones(benchmarks: SimpleNamespace) -> None:
    """M8 and survey class, code in m and phase in mm, within a third of what `galway_a_glw1` shows at each range of elevations."""
    runs = [benchmarks.pair_errors.of_pair(benchmarks.pair_errors.simulated_pair(M8, SURVEY, 80, seed)) for seed in range(6)]
    code, phase = (benchmarks.error_series.describe([s for found in runs for s in found[kind]]) for kind in ("code", "phase"))
    assert code.sigma_m == pytest.approx((1.49, 0.93, 0.60), rel=0.35)
    assert phase.sigma_m == pytest.approx((7.4e-3, 4.6e-3, 2.9e-3), rel=0.35)
    assert code.correlation[0] > 0.9
    assert code.correlation[2] == pytest.approx(0.42, abs=0.2)


def test_code_minus_phase_sees_what_multipath_changes(benchmarks: SimpleNamespace) -> None:
    """One receiver alone: its codes' errors about their means, without what lasts for ever, at more than 50 degrees."""
    pair = benchmarks.pair_errors.simulated_pair(SURVEY, SURVEY, 300, 2)
    described = benchmarks.error_series.describe(benchmarks.code_minus_phase.of_receiver(pair.rover, pair.navigation))
    assert described.sigma_m[2] == pytest.approx(0.17, rel=0.35)
    assert 0.6 < described.correlation[0] < 0.95
