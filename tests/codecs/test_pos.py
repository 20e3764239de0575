""".pos text: RTKLIB's widths, names and rounding."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtkmesh.codecs.pos import (
    Angles,
    Coordinates,
    PosFormat,
    TimeForm,
    TimeSystem,
    Velocity,
    pos_header,
    pos_line,
    position_note,
    time_note,
)
from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.solution import Solution, Status

LAT, LON, HEIGHT = np.radians(35.339325773), np.radians(139.522173121), 65.7169
POSITION = ecef_from_geodetic(LAT, LON, HEIGHT)
BASE = np.array([-3959400.631, 3385704.533, 3667523.111])
ROTATION = enu_from_ecef(LAT, LON)
COV_ENU = np.array(
    [[0.0033**2, -(0.0014**2), -(0.0030**2)], [-(0.0014**2), 0.0034**2, -(0.0015**2)], [-(0.0030**2), -(0.0015**2), 0.0074**2]]
)
SOLUTION = Solution(
    GpsTime(2149, 475219.0),
    Status.FIX,
    position_ecef_m=POSITION,
    position_cov_ecef_m2=ROTATION.T @ COV_ENU @ ROTATION,
    velocity_ecef_mps=ROTATION.T @ np.array([1.0, -2.0, 0.5]),
    velocity_cov_ecef_m2ps2=ROTATION.T @ np.diag([0.01, 0.04, 0.09]) @ ROTATION,
    base_ecef_m=BASE,
    baseline_ecef_m=POSITION - BASE,
    baseline_cov_ecef_m2=ROTATION.T @ COV_ENU @ ROTATION,
    satellites_used=21,
    age_s=0.0,
    ratio=16.7,
)
TOW = PosFormat(time_form=TimeForm.TOW)


def test_llh_line_is_rtklibs() -> None:
    """The line that rnx2rtkp 2.4.3 b34 writes for the same numbers (kanagawa_2021_078_60s), order north, east, up."""
    place = "2149 475219.000   35.339325773  139.522173121    65.7169   1  21"
    line = f"{place}   0.0034   0.0033   0.0074  -0.0014  -0.0030  -0.0015   0.00   16.7\n"
    assert pos_line(SOLUTION, TOW) == line


def test_sexagesimal_line_is_rtklibs() -> None:
    """Degrees, minutes, seconds stand in three fields each."""
    line = pos_line(SOLUTION, replace(TOW, angles=Angles.SEXAGESIMAL))
    assert line.startswith("2149 475219.000   35 20 21.57278  139 31 19.82324    65.7169   1  21   0.0034")


@pytest.mark.parametrize(
    ("degrees", "text"), [(-0.5, "  -0 30 00.00000"), (-122.999999999, "-123 00 00.00000"), (7.25, "   7 15 00.00000")]
)
def test_sexagesimal_rounding(degrees: float, text: str) -> None:
    """60 seconds are the next minute; the sign stands before the degrees, also when they are 0."""
    there = replace(SOLUTION, position_ecef_m=ecef_from_geodetic(0.1, np.radians(degrees), 0.0))
    assert text in pos_line(there, PosFormat(angles=Angles.SEXAGESIMAL))


def test_enu_line() -> None:
    """The baseline is in the base's horizon, order east, north, up; without a base there is no line."""
    line = pos_line(SOLUTION, PosFormat(Coordinates.ENU)).split()
    assert [float(value) for value in line[2:5]] == pytest.approx([5100.2133, 1404.2528, 17.0243], abs=2e-4)
    assert line[7:13] == ["0.0033", "0.0034", "0.0074", "-0.0014", "-0.0015", "-0.0030"]
    assert not pos_line(replace(SOLUTION, base_ecef_m=np.full(3, np.nan)), PosFormat(Coordinates.ENU))


def test_xyz_line_with_velocity() -> None:
    """Velocity columns follow in the same axes."""
    line = pos_line(SOLUTION, PosFormat(Coordinates.XYZ, velocity=Velocity.WRITTEN)).split()
    assert [float(value) for value in line[2:5]] == pytest.approx(POSITION.tolist(), abs=5e-5)
    assert [float(value) for value in line[15:18]] == pytest.approx(SOLUTION.velocity_ecef_mps.tolist(), abs=5e-6)
    assert len(line) == 24


def test_llh_velocity_is_north_east_up() -> None:
    """In llh the velocity is north, east, up, with its deviations."""
    line = pos_line(SOLUTION, PosFormat(velocity=Velocity.WRITTEN)).split()
    assert line[15:24] == ["-2.00000", "1.00000", "0.50000", "0.20000", "0.10000", "0.30000", *line[21:24]]
    assert all(abs(float(value)) < 1e-5 for value in line[21:24])


@pytest.mark.parametrize(
    ("tow_s", "form", "text"),
    [
        (475219.0, PosFormat(), "2021/03/19 12:00:19.000"),
        (475219.9996, PosFormat(), "2021/03/19 12:00:20.000"),
        (604799.9999, PosFormat(), "2021/03/21 00:00:00.000"),
        (604799.9999, TOW, "2150      0.000"),
        (475219.25, PosFormat(time_decimals=0), "2021/03/19 12:00:19"),
        (475219.25, PosFormat(time_decimals=1), "2021/03/19 12:00:19.2"),
        (475219.0, PosFormat(time_system=TimeSystem.UTC), "2021/03/19 12:00:01.000"),
        (5.0, replace(TOW, time_system=TimeSystem.UTC), "2148 604787.000"),
    ],
)
def test_times(tow_s: float, form: PosFormat, text: str) -> None:
    """Times are rounded before they are cut into fields, so no field shows 60 or 604800."""
    assert pos_line(replace(SOLUTION, time=GpsTime(2149, tow_s)), form).startswith(text + " ")


def test_separator_keeps_widths() -> None:
    """Fields keep their widths behind another separator, as RTKLIB's do."""
    assert pos_line(SOLUTION, replace(TOW, separator=",")).startswith(
        "2149,475219.000,  35.339325773, 139.522173121,   65.7169,  1, 21,  0.0034"
    )


def test_epochs_without_solution_print_nothing() -> None:
    """No solution, no line; a single-point solution has one."""
    assert not pos_line(Solution(GpsTime(2149, 0.0)), PosFormat())
    assert pos_line(replace(SOLUTION, status=Status.SINGLE), TOW).split()[5] == "5"


def test_unknown_values() -> None:
    """What is not known is printed as 0, as RTKLIB does; negative variances too."""
    bare = Solution(GpsTime(2149, 0.0), Status.SINGLE, position_ecef_m=POSITION)
    assert pos_line(bare, PosFormat(velocity=Velocity.WRITTEN)).split()[7:15] == [*["0.0000"] * 6, "0.00", "0.0"]
    wrong = replace(SOLUTION, position_cov_ecef_m2=-np.eye(3))
    assert pos_line(wrong, PosFormat(Coordinates.XYZ)).split()[7:10] == ["0.0000"] * 3


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("kanagawa_2021_078_60s/rtklib/kin_l12_gej.b34.pos", PosFormat(Coordinates.XYZ)),
        ("nl_cors_2021_001/rtklib/zegv_delf_kin_30s.b34.pos", PosFormat(Coordinates.XYZ)),
    ],
)
def test_lines_of_rtklib_come_back(name: str, form: PosFormat, data: Path) -> None:
    """RTKLIB's own xyz lines, read into solutions and written again, are the same text."""
    lines = [line.rstrip() for line in (data / name).read_text().splitlines()]
    columns = next(line for line in lines if line.startswith("%  GPST"))
    assert pos_header(form, "RTKLIB ver.2.4.3").splitlines()[-1] == columns
    assert pos_header(form, "RTKLIB ver.2.4.3").splitlines()[0] == lines[0]
    rows = [line for line in lines if line and not line.startswith("%")][:200]
    assert len(rows) >= 60
    for row in rows:
        assert pos_line(_solution(row), form).rstrip("\n") == row


def _solution(row: str) -> Solution:
    date, clock, *numbers = row.split()
    year, month, day = (int(part) for part in date.split("/"))
    hour, minute, second = clock.split(":")
    values = [float(number) for number in numbers]
    a, b, c, ab, bc, ca = (np.sign(value) * value * value for value in values[5:11])
    return Solution(
        GpsTime.from_calendar(year, month, day, int(hour), int(minute), float(second)),
        Status(int(values[3])),
        position_ecef_m=np.array(values[:3]),
        position_cov_ecef_m2=np.array([[a, ab, ca], [ab, b, bc], [ca, bc, c]]),
        satellites_used=int(values[4]),
        age_s=values[11],
        ratio=values[12],
    )


def test_notes_are_rtklibs() -> None:
    """Times and positions stand in the header as rnx2rtkp writes them."""
    assert time_note(GpsTime(2149, 475200.0)) == "2021/03/19 12:00:00.0 GPST (week2149 475200.0s)"
    assert position_note((-3959400.631, 3385704.533, 3667523.111)) == " -3959400.6310   3385704.5330   3667523.1110"
    header = pos_header(PosFormat(), "rtkmesh 1", [("inp file", "rover.obs")]).splitlines()
    assert header[:3] == ["% program   : rtkmesh 1", "% inp file  : rover.obs", "%"]


LLH_NAMES = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
ENU_NAMES = "e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns   sde(m)   sdn(m)   sdu(m)  sden(m)  sdnu(m)  sdue(m) age(s)  ratio"


@pytest.mark.parametrize(
    ("form", "columns"),
    [
        (PosFormat(), "%  GPST                  " + LLH_NAMES),
        (PosFormat(time_system=TimeSystem.UTC), "%  UTC                   " + LLH_NAMES),
        (TOW, "%  GPST          " + LLH_NAMES),
        (PosFormat(Coordinates.ENU), "%  GPST                  " + ENU_NAMES),
    ],
)
def test_column_names(form: PosFormat, columns: str) -> None:
    """The column line is rnx2rtkp's."""
    assert pos_header(form, "x").splitlines()[-1] == columns
