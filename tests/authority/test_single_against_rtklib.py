"""Single-point positions of real recordings: no worse than RTKLIB 2.4.3 b34's on the same files, and near the known coordinates."""

import subprocess
from pathlib import Path

import hatanaka
import numpy as np
import pytest

from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.single import SinglePoint, SinglePointOptions, single_point

pytestmark = [pytest.mark.data, pytest.mark.rtklib]

CONFIGURATION = """
pos1-posmode=single
pos1-frequency=l1
pos1-elmask=10
pos1-ionoopt=brdc
pos1-tropopt=saas
pos1-sateph=brdc
pos1-posopt5=on
pos1-navsys=61
out-solformat=xyz
out-timesys=gpst
out-timeform=tow
"""

KANAGAWA = "kanagawa_2021_078_60s/"
NL = "nl_cors_2021_001/"

# (observation, navigation, known position, every n-th epoch, bound of our median 3D error in m)
STATIONS = (
    (KANAGAWA + "SEPT078M1.21O", [KANAGAWA + "SEPT078M.21P"], (-3962108.673, 3381309.574, 3668678.638), 1, 2.2),
    (KANAGAWA + "3034078M1.21O", [KANAGAWA + "SEPT078M.21P"], (-3959400.631, 3385704.533, 3667523.111), 1, 1.2),
    ("galway_m8p/glw1277m.18o", ["galway_m8p/glw1277m.18n", "galway_m8p/glw1277m.18g"], (3774050.963, -601852.673, 5089350.369), 4, 2.0),
    (NL + "delf0010.21d", [NL + "CBW100NLD_R_20210010000_01D_MN.rnx"], (3924687.7327, 301132.7684, 5001910.8144), 10, 3.0),
)


def read(data: Path, observation: str, navigation: list[str]) -> tuple[list[Epoch], EphemerisTable, SinglePointOptions]:
    table, options = EphemerisTable(), SinglePointOptions()
    for name in navigation:
        file = read_navigation((data / name).read_bytes())
        for ephemeris in file.ephemerides:
            table.add(ephemeris)
        options = next((SinglePointOptions(klobuchar=k) for k in file.klobuchar if k.system == "G"), options)
    text = (data / observation).read_bytes()
    return list(ObservationReader(hatanaka.decompress(text) if observation.endswith("d") else text)), table, options


def by_rtklib(
    program: str, folder: Path, data: Path, observation: str, navigation: list[str], interval_s: float
) -> dict[float, np.ndarray]:
    """Return RTKLIB's positions by time of week."""
    source = data / observation
    if observation.endswith("d"):
        source = folder / "rover.obs"
        source.write_bytes(hatanaka.decompress((data / observation).read_bytes()))
    (folder / "single.conf").write_text(CONFIGURATION)
    out = folder / "out.pos"
    command = [
        program,
        "-k",
        str(folder / "single.conf"),
        "-ti",
        str(interval_s),
        "-o",
        str(out),
        str(source),
        *(str(data / n) for n in navigation),
    ]
    subprocess.run(command, capture_output=True, check=True, timeout=120)
    lines = [line.split() for line in out.read_text().splitlines() if not line.startswith("%")]
    return {round(float(f[1]), 2): np.array([float(v) for v in f[2:5]]) for f in lines}


@pytest.mark.parametrize(("observation", "navigation", "known", "every", "bound_m"), STATIONS)
def test_median_error_at_known_stations(data, rtklib_program, tmp_path, observation, navigation, known, every, bound_m):
    epochs, table, options = read(data, observation, navigation)
    epochs = epochs[::every]
    solutions = [single_point(epoch, table, options) for epoch in epochs]
    assert all(solution.ok for solution in solutions)
    interval_s = epochs[1].time - epochs[0].time
    theirs = by_rtklib(rtklib_program("rnx2rtkp"), tmp_path, data, observation, navigation, interval_s)
    assert len(theirs) > 0.9 * len(epochs)
    ours_m = np.median([np.linalg.norm(solution.position_ecef_m - known) for solution in solutions])
    theirs_m = np.median([np.linalg.norm(position - known) for position in theirs.values()])
    assert ours_m < bound_m
    assert ours_m < 1.1 * theirs_m
    common = [solution for solution in solutions if round(solution.time.tow_s, 2) in theirs]
    assert len(common) > 0.9 * len(epochs)
    assert np.median([np.linalg.norm(s.position_ecef_m - theirs[round(s.time.tow_s, 2)]) for s in common]) < 3.0


@pytest.fixture(scope="module")
def tokyo(data) -> tuple[list[Epoch], EphemerisTable, SinglePointOptions]:
    epochs, table, options = read(data, "tokyo_static/rover.obs", ["tokyo_static/base.nav"])
    return epochs[::20], table, options


def test_a_static_receiver_stands_still_within_its_covariance(tokyo):
    epochs, table, options = tokyo
    solutions = [single_point(epoch, table, options) for epoch in epochs]
    speeds = np.array([solution.velocity_ecef_mps for solution in solutions])
    assert np.sqrt((speeds**2).sum(axis=1).mean()) < 0.03
    sigma = np.sqrt([np.trace(solution.velocity_cov_ecef_m2ps2) for solution in solutions])
    assert (np.linalg.norm(speeds, axis=1) < 3.0 * sigma).all()
    positions = np.array([solution.position_ecef_m for solution in solutions])
    assert np.linalg.norm(positions - np.median(positions, axis=0), axis=1).max() < 2.0


@pytest.mark.parametrize("fault_m", [40.0, 1e3, -3e5])
def test_injected_faults_on_real_codes_do_not_move_the_position(tokyo, fault_m):
    """In a real epoch a quarter of each system's satellites is made wrong; they are named, and hardly a good one with them."""
    epochs, table, options = tokyo
    random = np.random.default_rng(11)
    for epoch in epochs:
        clean = single_point(epoch, table, options)
        used = clean.satellites[clean.used]
        wrong = np.concatenate([random.choice(group, len(group) // 4, replace=False) for group in _by_system(used)])
        faulty = single_point(_shifted(epoch, wrong, fault_m), table, options)
        assert _distance_m(faulty, clean) < 3.0
        assert set(wrong.tolist()) <= set(faulty.rejected)
        assert len(faulty.rejected) <= len(wrong) + 1


def _by_system(satellites: np.ndarray) -> list[np.ndarray]:
    return [satellites[satellites // 64 == system] for system in np.unique(satellites // 64)]


def _shifted(epoch: Epoch, satellites: np.ndarray, fault_m: float) -> Epoch:
    codes = np.where(np.isin(epoch.satellite, satellites), epoch.pseudorange_m + fault_m, epoch.pseudorange_m)
    columns = {name: getattr(epoch, name) for name in Epoch.__slots__}
    return Epoch(**{**columns, "pseudorange_m": codes})


def _distance_m(a: SinglePoint, b: SinglePoint) -> float:
    assert a.ok
    assert b.ok
    return float(np.linalg.norm(a.position_ecef_m - b.position_ecef_m))
