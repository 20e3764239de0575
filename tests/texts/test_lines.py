"""Lines of llh, xyz, enu and vel_enu: RTKLIB's widths, names and rounding, in closed form."""

from dataclasses import replace
from math import nan
from typing import Any

import msgspec
import pytest
from tests.texts.solutions import ecef, message

from rtkmesh_services.texts import TextAbout, TextOptions, TextWriter
from rtkmesh_services.texts.geodesy import enu_rotation, geodetic
from rtkmesh_services.texts.header import position_note, time_note

POSITION = ecef(35.339325773, 139.522173121, 65.7169)
BASE = (-3959400.631, 3385704.533, 3667523.111)
ROTATION = enu_rotation(*geodetic(POSITION)[:2])
COVARIANCE_ENU = (0.0033**2, -(0.0014**2), -(0.0030**2), -(0.0014**2), 0.0034**2, -(0.0015**2), -(0.0030**2), -(0.0015**2), 0.0074**2)


def to_ecef(matrix: tuple[float, ...]) -> tuple[float, ...]:
    """Return a covariance that is east-north-up at POSITION in ECEF: Rᵀ C R."""
    half = [[sum(matrix[3 * i + k] * ROTATION[3 * k + j] for k in range(3)) for j in range(3)] for i in range(3)]
    return tuple(sum(ROTATION[3 * k + i] * half[k][j] for k in range(3)) for i in range(3) for j in range(3))


def vector_to_ecef(*enu: float) -> Any:
    """Return a vector of east, north, up at POSITION in ECEF."""
    return tuple(sum(ROTATION[3 * k + i] * enu[k] for k in range(3)) for i in range(3))


SOLUTION = message(
    position_ecef_m=POSITION,
    position_cov_ecef_m2=to_ecef(COVARIANCE_ENU),
    velocity_ecef_mps=vector_to_ecef(1.0, -2.0, 0.5),
    velocity_cov_ecef_m2ps2=to_ecef((0.01, 0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.0, 0.09)),
    base_ecef_m=BASE,
    baseline_ecef_m=tuple(a - b for a, b in zip(POSITION, BASE, strict=True)),
    baseline_cov_ecef_m2=to_ecef(COVARIANCE_ENU),
    age_s=0.0,
    ratio=16.7,
)
TOW = TextOptions(time_form="tow")


def write(solution: Any = SOLUTION, options: TextOptions = TOW, **changes: Any) -> str:
    """Return the text of a solution with other values."""
    return TextWriter(options).text(msgspec.structs.replace(solution, **changes))


def test_llh_line_is_rtklibs() -> None:
    """The line that rnx2rtkp 2.4.3 b34 writes for the same numbers (kanagawa_2021_078_60s), order north, east, up."""
    place = "2149 475219.000   35.339325773  139.522173121    65.7169   1  21"
    assert write() == f"{place}   0.0034   0.0033   0.0074  -0.0014  -0.0030  -0.0015   0.00   16.7\r\n"


@pytest.mark.parametrize(
    ("options", "end"),
    [
        (TOW, "\r\n"),
        (replace(TOW, dialect="2.4"), "\n"),
        (replace(TOW, line_end="lf"), "\n"),
        (replace(TOW, dialect="2.4", line_end="crlf"), "\r\n"),
        (replace(TOW, format="vel_enu"), "\n"),
    ],
)
def test_ends_of_lines(options: TextOptions, end: str) -> None:
    """2.4.3 and demo5 end lines with CR LF, 2.4.2 and rtkrcv_ros with LF; headers too."""
    for text in (write(options=options), TextWriter(options).header(TextAbout("x")).decode()):
        assert text.splitlines(keepends=True)[-1].removesuffix(end).rstrip("\r\n") == text.splitlines()[-1]
        assert text.endswith(end)
        assert ("\r" in text) == ("\r" in end)


@pytest.mark.parametrize(
    ("degrees", "text"),
    [(-0.5, "  -0 30 00.00000"), (-122.999999999, "-123 00 00.00000"), (7.25, "   7 15 00.00000"), (-0.0000000001, "  -0 00 00.00000")],
)
def test_sexagesimal_rounding(degrees: float, text: str) -> None:
    """60 seconds are the next minute; the sign stands before the degrees, also when they are 0."""
    assert text in write(options=replace(TOW, angles="dms"), position_ecef_m=ecef(5.0, degrees, 0.0))


def test_enu_line() -> None:
    """The baseline is in the base's horizon, order east, north, up; without a base there is no line."""
    line = write(options=replace(TOW, format="enu")).split()
    assert [float(value) for value in line[2:5]] == pytest.approx([5100.2133, 1404.2528, 17.0243], abs=2e-4)
    assert line[7:13] == ["0.0033", "0.0034", "0.0074", "-0.0014", "-0.0015", "-0.0030"]
    assert not write(options=replace(TOW, format="enu"), base_ecef_m=(nan,) * 3)


def test_enu_line_of_a_single_point() -> None:
    """Where only positions are known the baseline is their difference, as RTKLIB's always is."""
    options = replace(TOW, format="enu")
    whole = write(options=options)
    assert write(options=options, baseline_ecef_m=(nan,) * 3, baseline_cov_ecef_m2=(nan,) * 9) == whole


def test_xyz_line_with_velocity() -> None:
    """Velocity columns follow in the same axes."""
    line = write(options=replace(TOW, format="xyz", velocity=True)).split()
    assert [float(value) for value in line[2:5]] == pytest.approx(POSITION, abs=5e-5)
    assert [float(value) for value in line[15:18]] == pytest.approx(SOLUTION.velocity_ecef_mps, abs=5e-6)
    assert len(line) == 24


def test_llh_velocity_is_north_east_up() -> None:
    """In llh the velocity is north, east, up, with its deviations."""
    line = write(options=replace(TOW, velocity=True)).split()
    assert line[15:21] == ["-2.00000", "1.00000", "0.50000", "0.20000", "0.10000", "0.30000"]
    assert all(abs(float(value)) < 1e-5 for value in line[21:24])


def test_vel_enu_line_is_rtkrcv_ros_one() -> None:
    """The velocity in the base's horizon with deviations in the order of its axes, and its own column names; no velocity, no line."""
    options = replace(TOW, format="vel_enu")
    there = write(options=options, base_ecef_m=POSITION)
    place = "2149 475219.000         1.0000        -2.0000         0.5000   1  21"
    assert there.startswith(f"{place}   0.1000   0.2000   0.3000 ")
    assert there.endswith("   0.00   16.7\n")
    assert not write(options=options, velocity_ecef_mps=(nan,) * 3)
    names = (
        "   V_East(m/s)   V North(m/s)      V Up(m/s)   Q  ns std_VE(m/s) std_VN(m/s) std_VU(m/s) std_VEN(m/s) std_VNU(m/s) std_VEU(m/s)"
    )
    assert TextWriter(options).header(TextAbout("x")).decode().splitlines()[-1] == f"%  GPST         {names} age(s)  ratio"


@pytest.mark.parametrize(
    ("tow_s", "options", "text"),
    [
        (475219.0, TextOptions(), "2021/03/19 12:00:19.000"),
        (475219.9996, TextOptions(), "2021/03/19 12:00:20.000"),
        (475259.9996, TextOptions(), "2021/03/19 12:01:00.000"),
        (604799.9999, TextOptions(), "2021/03/21 00:00:00.000"),
        (604799.9999, TOW, "2150      0.000"),
        (475219.25, TextOptions(time_decimals=0), "2021/03/19 12:00:19"),
        (475219.25, TextOptions(time_decimals=1), "2021/03/19 12:00:19.2"),
        (475219.0, TextOptions(time_system="utc"), "2021/03/19 12:00:01.000"),
        (475219.0, TextOptions(time_system="jst"), "2021/03/19 21:00:01.000"),
        (5.0, replace(TOW, time_system="utc"), "2148 604787.000"),
        (5.0, replace(TOW, time_system="jst"), "2149  32387.000"),
        (0.000000000001, TextOptions(time_decimals=12), "2021/03/14 00:00:00.000000000001"),
    ],
)
def test_times(tow_s: float, options: TextOptions, text: str) -> None:
    """Times are rounded before they are cut into fields, so no field shows 60 or 604800."""
    assert write(options=options, tow_s=tow_s).startswith(text + " ")


@pytest.mark.parametrize(
    ("week", "tow_s", "text"),
    [(1930, 16.999, "2016/12/31 23:59:59.999"), (1930, 18.0, "2017/01/01 00:00:00.000"), (1930, 19.5, "2017/01/01 00:00:01.500")],
)
def test_leap_second(week: int, tow_s: float, text: str) -> None:
    """Around the leap second of 2017, whose 23:59:60 RTKLIB's time has no name for, UTC steps from 17 to 18 seconds behind."""
    assert write(options=TextOptions(time_system="utc"), week=week, tow_s=tow_s).startswith(text)


def test_separators_keep_widths() -> None:
    """Fields keep their widths behind another separator, as RTKLIB's do; an empty one is a blank."""
    assert write(options=replace(TOW, separator=",")).startswith(
        "2149,475219.000,  35.339325773, 139.522173121,   65.7169,  1, 21,  0.0034"
    )
    assert write(options=replace(TOW, separator="\\t")).startswith("2149\t475219.000\t  35.339325773")
    assert write(options=replace(TOW, separator="")) == write()


def test_geodetic_height() -> None:
    """Above the geoid the height is smaller by its 37.55 m there (EGM96)."""
    line = write(options=replace(TOW, height="geodetic")).split()
    assert float(line[4]) == pytest.approx(65.7169 - 37.55, abs=0.01)
    assert b"lat/lon/height=WGS84/geodetic" in TextWriter(replace(TOW, height="geodetic")).header(TextAbout("x"))


@pytest.mark.parametrize("format_", ["llh", "xyz", "enu", "vel_enu", "nmea", "stat"])
def test_epochs_without_solution_print_nothing(format_: Any) -> None:
    """No solution, no line; nor without a position."""
    options = TextOptions(format=format_)
    assert write(options=options)
    assert not write(options=options, status=0)
    assert not write(options=options, position_ecef_m=(nan,) * 3)


def test_unknown_values() -> None:
    """What is not known is printed as 0, as RTKLIB does; negative variances too."""
    bare = message(status=5, position_ecef_m=POSITION)
    assert write(bare, replace(TOW, velocity=True)).split()[7:15] == [*["0.0000"] * 6, "0.00", "0.0"]
    assert "nan" not in write(bare, replace(TOW, velocity=True))
    wrong = msgspec.structs.replace(SOLUTION, position_cov_ecef_m2=(-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0))
    assert write(wrong, replace(TOW, format="xyz")).split()[7:10] == ["0.0000"] * 3


def test_headers() -> None:
    """Notes, those of options only when asked for, legend and names; off leaves the names, as RTKLIB does, none nothing."""
    about = TextAbout("rtkmesh 1", [("inp file", "rover.obs")], [("pos mode", "kinematic")])
    lines = TextWriter(TextOptions(header_options=True)).header(about).decode().splitlines()
    assert lines[:4] == ["% program   : rtkmesh 1", "% inp file  : rover.obs", "% pos mode  : kinematic", "%"]
    assert "% pos mode" not in TextWriter(TextOptions()).header(about).decode()
    assert TextWriter(TextOptions(header="off")).header(about).decode() == lines[-1] + "\r\n"
    assert TextWriter(TextOptions(header="none")).header(about) == b""


def test_notes_are_rtklibs() -> None:
    """Times and positions stand in the header as rnx2rtkp writes them; times are rounded."""
    assert time_note(2149, 475200.0) == "2021/03/19 12:00:00.0 GPST (week2149 475200.0s)"
    assert time_note(2149, 475219.99) == "2021/03/19 12:00:20.0 GPST (week2149 475220.0s)"
    assert position_note(BASE) == " -3959400.6310   3385704.5330   3667523.1110"


LLH_NAMES = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
ENU_NAMES = "e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns   sde(m)   sdn(m)   sdu(m)  sden(m)  sdnu(m)  sdue(m) age(s)  ratio"


@pytest.mark.parametrize(
    ("options", "columns"),
    [
        (TextOptions(), "%  GPST                  " + LLH_NAMES),
        (TextOptions(time_system="utc"), "%  UTC                   " + LLH_NAMES),
        (TOW, "%  GPST          " + LLH_NAMES),
        (TextOptions(format="enu"), "%  GPST                  " + ENU_NAMES),
    ],
)
def test_column_names(options: TextOptions, columns: str) -> None:
    """The column line is rnx2rtkp's."""
    assert TextWriter(options).header(TextAbout("x")).decode().splitlines()[-1] == columns
