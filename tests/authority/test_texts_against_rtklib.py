"""Texts of solutions against RTKLIB's own, byte for byte: demo5 in this process (pyrtklib5), 2.4.3 b34's rnx2rtkp and rtkrcv.

Differences that are meant have tests of their own here; docs/reference/texts.md lists them.
"""

import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from math import copysign, nan, radians
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tests.texts.solutions import Drawn, Row, drawn, ecef, line_options, matrix, message, sentences, single, table

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.texts import TextAbout, TextOptions, TextWriter
from rtkmesh_services.texts.geoid import geoid_height_m
from rtkmesh_services.texts.nmea_satellites import gsa, gsv
from rtkmesh_services.texts.sky import dops, satellites_of

rtklib: Any = pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")

pytestmark = pytest.mark.rtklib

_BYTES = getattr(rtklib, "Arr1Dunsigned char")
_FORMATS = {"llh": rtklib.SOLF_LLH, "xyz": rtklib.SOLF_XYZ, "enu": rtklib.SOLF_ENU, "nmea": rtklib.SOLF_NMEA, "stat": rtklib.SOLF_STAT}
_SYSTEMS = {"gpst": 0, "utc": 1, "jst": 2}
ABOUT = TextAbout("rtkmesh")


def written(function: Callable[..., int], *arguments: Any) -> bytes:
    """Return what one of RTKLIB's functions writes."""
    buffer = _BYTES(32768)
    return bytes(buffer[k] for k in range(function(buffer, *arguments)))


def sol(numbers: Drawn) -> Any:
    """Return RTKLIB's solution."""
    out = rtklib.sol_t()
    out.time, out.stat, out.ns = rtklib.gpst2time(numbers.week, numbers.tow_s), numbers.status, numbers.satellites
    out.age, out.ratio = numbers.age_s, numbers.ratio
    for k in range(3):
        out.rr[k], out.rr[3 + k] = numbers.position_ecef_m[k], numbers.velocity_ecef_mps[k]
    for k in range(6):
        out.qr[k], out.qv[k] = numbers.covariance[k], numbers.velocity_covariance[k]
    return out


def solopt(options: TextOptions) -> Any:
    """Return RTKLIB's options."""
    out = rtklib.solopt_t()
    out.posf, out.times, out.timef = _FORMATS[options.format], _SYSTEMS[options.time_system], int(options.time_form == "hms")
    out.timeu, out.degf, out.height = options.time_decimals, int(options.angles == "dms"), int(options.height == "geodetic")
    out.outvel, out.outhead, out.datum, out.geoid = int(options.velocity), int(options.header == "on"), 0, 0
    out.nmeaintv[0], out.nmeaintv[1] = options.interval_s, options.satellites_interval_s
    for k, character in enumerate(options.separator + "\0"):
        out.sep[k] = character
    return out


def base(numbers: Drawn) -> Any:
    """Return RTKLIB's base position and velocity."""
    out = rtklib.Arr1Ddouble(6)
    for k in range(3):
        out[k], out[3 + k] = numbers.base_ecef_m[k], 0.0
    return out


@settings(max_examples=400)
@given(numbers=drawn(), options=line_options)
def test_lines(numbers: Drawn, options: TextOptions) -> None:
    """llh, xyz and enu in every combination of options: the same bytes of the same numbers."""
    assert TextWriter(options).epoch(numbers.message()) == written(rtklib.outsols, sol(numbers), base(numbers), solopt(options))


@given(options=line_options)
def test_headers(options: TextOptions) -> None:
    """Legend and column names; sdun is called so in dms too, and enu has no names of velocities that no line has."""
    theirs = written(rtklib.outsolheads, solopt(replace(options, velocity=options.velocity and options.format != "enu")))
    if options.format == "llh" and options.angles == "dms":
        assert b"sdue(m)" in theirs
        theirs = theirs.replace(b"sdue(m)", b"sdun(m)")
    ours = TextWriter(options).header(ABOUT)
    assert ours == (b"% program   : rtkmesh\r\n%\r\n" if options.header == "on" else b"") + theirs


def test_names_of_velocities_that_no_line_has() -> None:
    """RTKLIB's header of enu announces nine columns of velocity that its lines lack."""
    options = TextOptions(format="enu", velocity=True, header="off")
    assert b"ve(m/s)" in written(rtklib.outsolheads, solopt(options))
    assert b"ve(m/s)" not in TextWriter(options).header(ABOUT)


@settings(max_examples=100)
@given(numbers=drawn())
def test_rmc_and_gga_with_rtklibs_habits(numbers: Drawn) -> None:
    """The same bytes; a GST follows, which 2.5.0 does not write yet. The course is held by each side on its own: both begin fast."""
    fast = replace(numbers, velocity_ecef_mps=tuple(value + 70.0 for value in numbers.velocity_ecef_mps))
    ours = TextWriter(sentences(nmea="rtklib")).epoch(fast.message())
    theirs = written(rtklib.outsols, sol(fast), base(fast), solopt(sentences()))
    assert b"".join(line for line in ours.splitlines(keepends=True) if line[3:6] != b"GST") == theirs
    assert ours.count(b"GST") == (numbers.status > 0)


def test_course_is_held() -> None:
    """Below 1 m/s the course is the last one, as RTKLIB's."""
    writer = TextWriter(sentences(nmea="rtklib"))
    for speed in (30.0, 0.5, 0.0):
        numbers = replace(_STANDING, velocity_ecef_mps=(speed, 0.0, 0.0))
        assert writer.epoch(numbers.message()).startswith(written(rtklib.outnmea_rmc, sol(numbers)))


@settings(max_examples=100)
@given(
    tow_s=st.one_of(st.integers(0, 604799).map(float), st.floats(0.0, 604799.9)),
    interval_s=st.sampled_from((-1.0, 0.0, 0.2, 1.0, 30.0)),
    dialect=st.just("demo5"),
)
def test_intervals(tow_s: float, interval_s: float, dialect: Any) -> None:
    """Sentences come at multiples of their interval, never if it is negative."""
    options, numbers = sentences(nmea="rtklib", interval_s=interval_s, dialect=dialect), replace(_STANDING, tow_s=tow_s)
    theirs = written(rtklib.outsols, sol(numbers), base(numbers), solopt(options))
    assert bool(TextWriter(options).epoch(numbers.message())) == bool(theirs)


_STANDING = Drawn(2149, 475219.0, 1, 12, ecef(35.0, 139.0, 60.0), (0.0,) * 3, ecef(35.0, 139.1, 60.0), (1.0,) * 6, (1.0,) * 6, 0.0, 3.0)
_NAMES = [f"{letter}{number:02d}" for letter, count in zip("GRECJI", (32, 24, 30, 40, 5, 7), strict=True) for number in range(1, count + 1)]


def _degrees(low: int, high: int) -> st.SearchStrategy[float]:
    """Return angles that no rounding to the decimals of a text is in doubt of."""
    return st.integers(low * 100, high * 100).map(lambda hundredths: hundredths / 100.0 + 0.003)


@st.composite
def skies(draw: st.DrawFn) -> list[Row]:
    """Return rows of satellites in any direction, used or not."""
    names = draw(st.lists(st.sampled_from([*_NAMES, *(f"S{number}" for number in range(20, 40))]), max_size=80, unique=True))
    row = st.tuples(
        st.sampled_from((0, 1, 3, 7)),
        _degrees(0, 359),
        _degrees(-5, 89),
        st.floats(10.0, 55.0).map(single),
    )
    return [(name, "1C", *draw(row)) for name in names]


def satellite_states(rows: list[Row]) -> Any:
    """Return RTKLIB's array of satellites, by its numbers."""
    out = rtklib.Arr1Dssat_t(rtklib.MAXSAT)
    for k in range(rtklib.MAXSAT):
        out[k].vs, out[k].azel[0], out[k].azel[1], out[k].snr_rover[0] = 0, 0.0, 0.0, 0.0
    for name, _, state, azimuth_deg, elevation_deg, cn0_dbhz in rows:
        one = out[rtklib.satid2no(str(100 + int(name[1:])) if name[0] == "S" else name) - 1]
        one.vs, one.azel[0], one.azel[1], one.snr_rover[0] = int(state != 0), radians(azimuth_deg), radians(elevation_deg), cn0_dbhz
    return out


@settings(max_examples=100)
@given(rows=skies(), status=st.integers(0, 5))
def test_gsa_and_gsv_with_rtklibs_habits(rows: list[Row], status: int) -> None:
    """The satellites in the solution with DOPs, and those in view, per system: the same bytes."""
    solution, states = sol(replace(_STANDING, status=status)), satellite_states(rows)
    theirs = written(rtklib.outnmea_gsa, solution, states[0]) + written(rtklib.outnmea_gsv, solution, states[0])
    options, sky = sentences(nmea="rtklib"), satellites_of(table(rows))
    used = [one for one in sky if one.used]
    # Of satellites that are (nearly) in one cone RTKLIB prints what rounding leaves of the matrix.
    assume(sum(one.seen for one in used) < 4 or dops(used).pdop < 50.0)
    assert (gsa(sky, status > 0, options) + gsv(sky, status > 0, options)).encode() == theirs


@settings(max_examples=100)
@given(lat_deg=st.floats(-90.0, 90.0), lon_deg=st.floats(-180.0, 359.9))
def test_geoid(lat_deg: float, lon_deg: float) -> None:
    """The geoid is RTKLIB's to the last bit."""
    place = rtklib.Arr1Ddouble(3)
    place[0], place[1] = radians(lat_deg), radians(lon_deg)
    assert geoid_height_m(place[0], place[1]) == rtklib.geoidh(place)


@st.composite
def filters(draw: st.DrawFn) -> dict[str, Any]:
    """Return states of a filter and the figures of satellites."""
    number = st.floats(-100.0, 100.0).map(lambda value: round(value, 6))
    three = st.tuples(number, number, number)
    return {
        "float_position_ecef_m": ecef(draw(st.floats(-80.0, 80.0)), draw(st.floats(-180.0, 180.0)), 100.0),
        "float_velocity_ecef_mps": draw(three),
        "float_acceleration_ecef_mps2": draw(three),
        "acceleration_ecef_mps2": draw(three),
        "clocks_s": tuple(draw(st.lists(number.map(lambda value: value * 1e-6), min_size=7, max_size=7))),
    }


def rtk(numbers: Drawn, states: dict[str, Any], dynamics: bool) -> Any:
    """Return RTKLIB's filter with these states."""
    options = rtklib.prcopt_t()
    options.mode, options.nf, options.dynamics = rtklib.PMODE_KINEMA, 1, int(dynamics)
    options.ionoopt = options.tropopt = options.glomodear = 0
    out = rtklib.rtk_t()
    rtklib.rtkinit(out, options)
    out.sol = sol(numbers)
    clocks = states["clocks_s"]
    for k, value in enumerate((clocks[0], *(clocks[j] - clocks[0] for j in (1, 2, 3, 6, 4)))):
        out.sol.dtr[k] = value
    floating = (*states["float_position_ecef_m"], *states["float_velocity_ecef_mps"], *states["float_acceleration_ecef_mps2"])
    fixed = (*numbers.position_ecef_m, *numbers.velocity_ecef_mps, *states["acceleration_ecef_mps2"])
    for k in range(9 if dynamics else 3):
        out.x[k], out.xa[k] = floating[k], fixed[k] if numbers.status == 1 else 0.0
    return out


@settings(max_examples=100)
@given(numbers=drawn(), states=filters(), dynamics=st.booleans())
def test_states(numbers: Drawn, states: dict[str, Any], dynamics: bool) -> None:
    """$POS, $VELACC and $CLK of the same filter are the same bytes."""
    numbers = replace(numbers, status=1 if numbers.status % 2 else 2)
    if not dynamics:
        states |= {"float_velocity_ecef_mps": (float("nan"),) * 3, "float_acceleration_ecef_mps2": (float("nan"),) * 3}
    text = rtklib.Arr1Dchar(32768)
    count = rtklib.rtkoutstat(rtk(numbers, states, dynamics), 1, text)
    solution = msgspec.structs.replace(numbers.message(), **states)
    assert TextWriter(TextOptions(format="stat")).text(solution) == text[0][:count]


@settings(max_examples=100)
@given(
    rows=st.lists(
        st.tuples(
            st.sampled_from((0, 2, 6, 10, 34)),
            _degrees(0, 359),
            _degrees(1, 89),
            st.floats(10.0, 55.0).map(single),
            st.tuples(*[st.floats(-50.0, 50.0).map(single)] * 2),
            st.tuples(*[st.integers(0, 3000)] * 3),
            st.floats(-1e6, 1e6),
            st.floats(0.0, 900.0),
        ),
        max_size=20,
    )
)
def test_satellites(rows: list[Any]) -> None:
    """$SAT of the satellites in the solution: the same bytes."""
    filter_ = rtk(_STANDING, _AT_REST, False)
    names = _NAMES[: len(rows)]
    for name, (state, azimuth_deg, elevation_deg, cn0_dbhz, residuals, counts, bias, variance) in zip(names, rows, strict=True):
        number = rtklib.satid2no(name)
        one = filter_.ssat[number - 1]
        one.vs, one.azel[0], one.azel[1], one.snr_rover[0] = int(state != 0), radians(azimuth_deg), radians(elevation_deg), cn0_dbhz
        one.resp[0], one.resc[0], one.vsat[0], one.fix[0] = *residuals, int(state != 0), 2 if state & 4 else int(state != 0)
        one.slip[0], one.lock[0], one.slipc[0], one.rejc[0] = (state & 8) // 8 | (state & 32) // 16, *counts
        filter_.x[2 + number], filter_.P[(2 + number) * (filter_.nx + 1)] = bias, variance
    text = rtklib.Arr1Dchar(32768)
    count = rtklib.rtkoutstat(filter_, 2, text)
    theirs = text[0][:count]
    satellites = table(
        [(name, "1C", row[0], *row[1:4]) for name, row in zip(names, rows, strict=True)],
        code_residual_m=[row[4][0] for row in rows], phase_residual_m=[row[4][1] for row in rows], lock_epochs=[row[5][0] for row in rows],
        slips=[row[5][1] for row in rows], rejects=[row[5][2] for row in rows], ambiguity_cyc=[row[6] for row in rows],
        ambiguity_variance_cyc2=[row[7] for row in rows], ionosphere_m=[nan] * len(rows),
    )  # fmt: skip
    ours = TextWriter(TextOptions(format="stat", status="residual")).text(_STANDING.message(), satellites)
    assert [line for line in ours.splitlines() if line.startswith("$SAT")] == [
        line for line in theirs.splitlines() if line.startswith("$SAT")
    ]


_AT_REST: dict[str, Any] = {
    "float_position_ecef_m": _STANDING.position_ecef_m, "float_velocity_ecef_mps": (0.0,) * 3, "float_acceleration_ecef_mps2": (0.0,) * 3,
    "acceleration_ecef_mps2": (0.0,) * 3, "clocks_s": (0.0,) * 7,
}  # fmt: skip


B34 = """
pos1-posmode=kinematic
pos1-frequency=l1+l2
pos1-elmask=15
pos1-navsys=13
pos1-dynamics=on
pos2-armode=continuous
ant2-postype=xyz
ant2-pos1=-3817680.7270
ant2-pos2=3562839.5216
ant2-pos3=3650159.2407
out-outvel=on
"""
_RUNS = (
    TextOptions(format="xyz", time_form="tow", velocity=True, time_decimals=2),
    TextOptions(format="xyz", separator=",", time_system="utc", velocity=True),
    TextOptions(format="llh", angles="dms", time_system="jst", time_decimals=0),
    TextOptions(format="llh", height="geodetic", separator="\\t", header="off"),
    TextOptions(format="enu", time_form="tow", header="off"),
)


@pytest.fixture(scope="module")
def b34(data: Path, rtklib_program: Callable[[str], str], tmp_path_factory: pytest.TempPathFactory) -> Callable[[TextOptions], bytes]:
    """A function that solves a minute with rnx2rtkp 2.4.3 b34 and returns its file."""
    program, folder = rtklib_program("rnx2rtkp"), tmp_path_factory.mktemp("b34")

    def run(options: TextOptions) -> bytes:
        words = {
            "solformat": options.format, "timesys": options.time_system, "timeform": options.time_form, "degform": options.angles,
            "timendec": options.time_decimals, "fieldsep": options.separator, "height": options.height, "outhead": options.header,
        }  # fmt: skip
        lines = [f"out-{name}={value}" for name, value in words.items() if value != " "]
        (folder / "options.conf").write_text(B34 + "\n".join(lines) + f"\nout-outvel={'on' if options.velocity else 'off'}\n")
        files = [str(data / "tokyo_static" / name) for name in ("rover.obs", "base.obs", "base.nav")]
        span = ["-ts", "2024/06/24", "08:20:00", "-te", "2024/06/24", "08:21:00"]
        subprocess.run(
            [program, "-k", str(folder / "options.conf"), *span, "-o", str(folder / "out.pos"), *files], check=True, capture_output=True
        )
        return (folder / "out.pos").read_bytes()

    return run


@pytest.mark.data
@pytest.mark.parametrize("options", _RUNS[:2], ids=("tow", "utc"))
def test_xyz_files_of_b34_come_back(options: TextOptions, b34: Callable[[TextOptions], bytes]) -> None:
    """Lines of rnx2rtkp, read into solutions and written again, are the same bytes, their ends and the column line included."""
    lines = b34(options).splitlines(keepends=True)
    writer = TextWriter(options)
    rows = [line for line in lines if not line.startswith(b"%")]
    assert len(rows) == 61
    assert [writer.epoch(_read(row.decode(), options)) for row in rows] == rows
    theirs = [line for line in lines if line.startswith(b"%")]
    ours = writer.header(TextAbout("rnx2rtkp ver.2.4.3 b34")).splitlines(keepends=True)
    assert (ours[-1], ours[-2]) == (theirs[-1], theirs[-2])


@pytest.mark.data
@pytest.mark.parametrize("options", _RUNS[2:], ids=("dms", "geodetic", "enu"))
def test_other_files_of_b34_agree_with_its_xyz(options: TextOptions, b34: Callable[[TextOptions], bytes]) -> None:
    """llh and enu, made of the xyz that the same run prints with four decimals, are its own within that rounding, field by field."""
    full = TextOptions(format="xyz", time_form="tow", velocity=True, time_decimals=6)
    solutions = [_read(row.decode(), full) for row in b34(full).splitlines() if not row.startswith(b"%")]
    lines = b34(options).splitlines(keepends=True)
    rows = [line.decode() for line in lines if not line.startswith(b"%")]
    for solution, row in zip(solutions, rows, strict=True):
        ours = TextWriter(options).epoch(solution).decode()
        assert len(ours) == len(row)
        assert ours.endswith("\r\n") == row.endswith("\r\n")
        assert _numbers(ours) == pytest.approx(_numbers(row), abs=3e-4)
    theirs = [line for line in lines if line.startswith(b"%")][-1]
    assert TextWriter(options).header(TextAbout("x")).splitlines(keepends=True)[-1] == theirs.replace(
        b"sdue", b"sdun" if options.format == "llh" else b"sdue"
    )


def _numbers(row: str) -> list[float]:
    return [float(text) for text in re.split(r"[ \t/:]+", row.strip())]


def _read(row: str, options: TextOptions) -> SolutionMessage:
    """Return the solution of a line of xyz with velocities."""
    fields = [field.strip() for field in (row.split(options.field_separator) if options.field_separator != " " else row.split())]
    if options.time_form == "tow":
        time = GpsTime(int(fields[0]), float(fields[1]))
    else:
        date, clock = fields[0].split()
        (year, month, day), (hour, minute, second) = date.split("/"), clock.split(":")
        time = GpsTime.from_utc(datetime(int(year), int(month), int(day), int(hour), int(minute), tzinfo=UTC)) + float(second)
        fields.insert(0, "")
    values = [float(field) for field in fields[2:]]
    base_ecef_m = (-3817680.7270, 3562839.5216, 3650159.2407)
    x, y, z = values[:3]
    squares = tuple(copysign(value * value, value) for value in (*values[5:11], *values[16:22]))
    return message(
        week=time.week, tow_s=time.tow_s, status=int(values[3]), satellites_used=int(values[4]), position_ecef_m=(x, y, z),
        position_cov_ecef_m2=matrix(squares[:6]), age_s=values[11], ratio=values[12], velocity_ecef_mps=tuple(values[13:16]),
        velocity_cov_ecef_m2ps2=matrix(squares[6:]), base_ecef_m=base_ecef_m,
    )  # fmt: skip
