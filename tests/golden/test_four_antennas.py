"""The recording of four antennas in motion: its main figures hold (benchmarks/four_antennas.py, every epoch; faults in some)."""

from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from rtkmesh.attitude.calibration import Calibration, calibrate
from rtkmesh.attitude.integrity import Finding

pytestmark = pytest.mark.data
NAMES = ("four_antennas",)


@pytest.fixture(scope="module")
def benchmark(benchmarks: SimpleNamespace) -> ModuleType:
    """The benchmark's module, which reads the recording."""
    return benchmarks.four_antennas


@pytest.fixture(scope="module")
def recording(benchmark: ModuleType, data: Path):
    return benchmark.read(data / benchmark.FOLDER)


@pytest.fixture(scope="module")
def calibration(benchmark: ModuleType, recording) -> Calibration:
    return calibrate(benchmark.ANTENNAS, [i for i in recording.instants if benchmark.antennas_of(i) >= 2])


def test_the_frame_is_calibrated_from_itself(calibration: Calibration):
    """A square of 0.80 m by 0.79 m; distances repeat to 13 mm; flat within the noise; errors that stay alike are in the sigmas."""
    lengths = {"-".join(row.names): row for row in calibration.distances}
    assert [lengths[pair].mean_m for pair in ("2-3", "2-4", "3-5", "5-4")] == pytest.approx([0.795, 0.792, 0.799, 0.798], abs=0.003)
    assert max(row.sd_m for row in calibration.distances) < 0.013
    assert min(row.within_pct for row in calibration.distances) > 98.9
    assert calibration.thickness_m < 3.0 * calibration.thickness_sigma_m
    assert 0.6 < calibration.scale_horizontal < 1.2
    assert calibration.variance_factor > 5.0
    assert 0.001 < calibration.sigmas_m[2, 0] < 0.004


def test_every_epoch_of_three_antennas_has_an_attitude(benchmark: ModuleType, recording, calibration: Calibration):
    """And it is the author's and the inertial system's but for frames, clocks (18 leap seconds) and noise."""
    ours = benchmark.verdicts(calibration.layout, [benchmark.scaled(i, calibration) for i in recording.instants])
    there = benchmark.availability(ours, recording)
    assert (there["epochs"], there["fitted_pct"]) == (797, 100.0)
    assert there["ok_pct"] > 95.0
    for theirs, shift_s, limits in ((recording.author, 0.0, (0.25, 0.7, 0.4)), (recording.inertial, -18.0, (0.6, 1.0, 1.1))):
        pairs = benchmark.paired(ours, theirs, shift_s)
        constant = benchmark.mean_rotation([mine.T @ other for mine, other in pairs])
        off = benchmark.differences_deg([(mine @ constant, other) for mine, other in pairs])
        assert np.all(np.median(np.abs(off), axis=0) < limits)
        assert len(pairs) > 700


@pytest.mark.parametrize("lost", [0, 1])
def test_faults_that_are_not_found_are_within_the_protection_levels(benchmark: ModuleType, recording, calibration: Calibration, lost: int):
    """Vertical faults of 5 to 20 cm that pass the tests: a good part is beyond its sigmas, none beyond its level."""
    instants = [benchmark.scaled(i, calibration) for i in recording.instants]
    ours = benchmark.verdicts(calibration.layout, instants)
    clean = [i for i in instants if benchmark.antennas_of(i) == 4 and ours[round(i.time_s)].finding is Finding.OK][::48]
    rows = [row for row in benchmark.faults(calibration.layout, clean, lost, np.random.default_rng(7)) if row["direction"] == "vertical"]
    assert max(row["outside"] for row in rows) > 30.0
    assert [row["beyond"] for row in rows] == [0.0] * len(rows)
    assert [row["wrong"] for row in rows if row["size_m"] != 0.2] == [0.0] * (len(rows) - 1)
