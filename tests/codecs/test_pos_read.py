""".pos files read: what our writer and rnx2rtkp write, and what is none."""

import subprocess

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.codecs.pos_read import Coordinates, read_pos
from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh.gnss.time import GpsTime

POSITION = ecef_from_geodetic(0.7, -0.006, 55.0)


TIMES = [("GPST", "2232 400000.250"), ("GPST", "2022/10/20 15:06:40.250"), ("UTC", "2022/10/20 15:06:22.250")]
LLH, DMS = "40.5 -0.25 55.0", "40 30 0.0 -0 15 0.0 55.0"


@pytest.mark.parametrize(("system", "time"), TIMES)
@pytest.mark.parametrize(("names", "numbers"), [("latitude(deg) longitude(deg)", LLH), ("latitude(d'\") longitude(d'\")", DMS)])
def test_geodetic_lines_are_read(system: str, time: str, names: str, numbers: str):
    """The same instant, place (also -0 degrees) and covariance, however they are written."""
    found = read_pos([f"%  {system}  {names}  height(m)   Q", f"{time} {numbers} 1 9 0.02 0.01 0.03 -0.005 0 0 0 5"])
    (row,) = found.rows
    assert abs(row.time - GpsTime(2232, 400_000.25)) < 1e-6
    assert row.vector_m == pytest.approx(ecef_from_geodetic(np.radians(40.5), np.radians(-0.25), 55.0), abs=1e-6)
    assert row.cov_enu_m2 == pytest.approx(np.array([[1e-4, -2.5e-5, 0.0], [-2.5e-5, 4e-4, 0.0], [0.0, 0.0, 9e-4]]))


def test_ecef_and_baselines_are_read():
    x, y, z = POSITION
    (row,) = read_pos(["%  GPST  x-ecef(m) y-ecef(m) z-ecef(m) Q", f"2232 1.0 {x} {y} {z} 2 9 0.01 0.01 0.01 0 0 0 0 5"]).rows
    assert (row.status, row.vector_m.tolist()) == (2, [x, y, z])
    assert row.cov_enu_m2 == pytest.approx(1e-4 * np.eye(3))
    found = read_pos(["%  GPST  e-baseline(m) n-baseline(m) u-baseline(m) Q", "2232 1.0 1 2 3 1 9 0.01 0.02 0.03 0 0 0.01 0 5"])
    assert (found.kind, found.rows[0].vector_m.tolist()) == (Coordinates.ENU, [1.0, 2.0, 3.0])
    assert found.rows[0].cov_enu_m2[0, 2] == pytest.approx(1e-4)


@given(st.lists(st.text(alphabet="0123456789-+./: %eEnaifx", max_size=120), max_size=6))
def test_nothing_in_a_file_raises(lines: list[str]):
    read_pos(["%  GPST  latitude(deg) longitude(deg)  height(m)   Q", *lines])


@pytest.mark.parametrize(
    "line",
    [
        "2022/10/20 15:30:08.000 39.4 -0.33 56.0 1 9 0.01 0.01 0.03 0 0",
        "2022/10/20 15:30:08.000 139.4 -0.33 56.0 1 9 0.01 0.01 0.03 0 0 0 0 0",
        "2022/13/20 15:30:08.000 39.4 -0.33 56.0 1 9 0.01 0.01 0.03 0 0 0 0 0",
        "2022/10/20 15:30:08.000 nan -0.33 56.0 1 9 0.01 0.01 0.03 0 0 0 0 0",
        "2022/10/20 15:30:08.000 39.4 -0.33 56.0 1 9 inf 0.01 0.03 0 0 0 0 0",
        "2232 nan 39.4 -0.33 56.0 1 9 0.01 0.01 0.03 0 0 0 0 0",
        "$GPGGA,153008.00,3928.88,N",
    ],
)
def test_lines_that_are_no_solutions_are_counted(line: str):
    found = read_pos(["%  GPST  latitude(deg) longitude(deg)  height(m)   Q", line, ""])
    assert (found.rows, found.skipped) == ([], 1)


@pytest.mark.rtklib
@pytest.mark.data
def test_rnx2rtkps_own_file(data, tmp_path, rtklib_program):
    folder = data / "tokyo_static"
    observations = sorted(folder.glob("*.obs"))
    if len(observations) < 2:
        pytest.skip("no RINEX files of two receivers")
    out = tmp_path / "x.pos"
    argv = [
        rtklib_program("rnx2rtkp"),
        "-p",
        "0",
        "-o",
        str(out),
        "-te",
        "2100/1/1",
        "0:0:0",
        str(observations[0]),
        *map(str, folder.glob("*.nav")),
    ]
    subprocess.run(argv, check=True, capture_output=True, timeout=120)
    found = read_pos(out.read_text().splitlines())
    assert found.skipped == 0
    assert len(found.rows) > 100
    assert all(row.status == 5 and 6.3e6 < np.linalg.norm(row.vector_m) < 6.4e6 for row in found.rows)
