""".pos files read: what our writer and rnx2rtkp write, and what is none."""

import subprocess

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.codecs.pos import Angles, Coordinates, PosFormat, TimeForm, TimeSystem, pos_header, pos_line
from rtkmesh.codecs.pos_read import read_pos
from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef_at
from rtkmesh.gnss.time import GpsTime

POSITION = ecef_from_geodetic(0.7, -0.006, 55.0)
ROOT = np.array([[0.01, 0.0, 0.0], [0.004, 0.012, 0.0], [-0.003, 0.006, 0.03]])


class Solution:
    time = GpsTime(2232, 400_000.25)
    status, satellites_used, age_s, ratio = 1, 9, 0.5, 12.0
    position_ecef_m, base_ecef_m = POSITION, POSITION - [1.0, 2.0, 3.0]
    baseline_ecef_m = np.array([1.0, 2.0, 3.0])
    position_cov_ecef_m2 = baseline_cov_ecef_m2 = ROOT @ ROOT.T
    velocity_ecef_mps, velocity_cov_ecef_m2ps2 = np.zeros(3), np.eye(3)


@pytest.mark.parametrize("kind", list(Coordinates))
@pytest.mark.parametrize("time_form", list(TimeForm))
@pytest.mark.parametrize("angles", list(Angles))
@pytest.mark.parametrize("system", list(TimeSystem))
def test_what_is_written_is_read(kind: Coordinates, time_form: TimeForm, angles: Angles, system: TimeSystem):
    """Time to a millisecond, coordinates to 0.2 mm, covariances to the digits of their roots."""
    if system is TimeSystem.UTC and time_form is TimeForm.TOW:
        return
    form = PosFormat(kind, time_form, system, angles=angles)
    found = read_pos((pos_header(form, "test", []) + pos_line(Solution(), form)).splitlines())
    (row,) = found.rows
    turn = enu_from_ecef_at(POSITION)
    vector = turn @ Solution.baseline_ecef_m if kind is Coordinates.ENU else POSITION
    assert (found.kind, found.skipped, row.status) == (kind, 0, 1)
    assert abs(row.time - Solution.time) < 1e-3
    assert row.vector_m == pytest.approx(vector, abs=2e-4)
    assert row.cov_enu_m2 == pytest.approx(turn @ Solution.position_cov_ecef_m2 @ turn.T, abs=4e-6)


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
