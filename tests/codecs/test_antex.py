"""ANTEX files: columns, grids, what is passed over, what is refused."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.codecs.antex import AntexFile, write_antex
from rtkmesh.errors import FormatError
from rtkmesh.gnss.antenna import AntennaCalibration, BandCalibration


def line(content: str, label: str) -> str:
    return f"{content:<60}{label}"


def frequency(code: str, north_east_up: str, rows: Sequence[str]) -> list[str]:
    return [
        line(f"   {code}", "START OF FREQUENCY"),
        line(north_east_up, "NORTH / EAST / UP"),
        *rows,
        line(f"   {code}", "END OF FREQUENCY"),
    ]


HEADER = [line("     1.4            M", "ANTEX VERSION / SYST"), line("A", "PCV TYPE / REFANT"), line("", "END OF HEADER")]
GRID = ["   NOAZI    0.00   -1.00   -2.00", "     0.0    0.00   -1.50   -2.50", "   180.0    0.00   -0.50   -1.50"]
RMS = [line("   G01", "START OF FREQ RMS"), line("      9.00      9.00      9.00", "NORTH / EAST / UP"), line("   G01", "END OF FREQ RMS")]


def antenna(name: str = "TRM1.00         TZGD", serial: str = "", rows: Sequence[str] = (), count: int = 2) -> list[str]:
    rows = rows or [*GRID, "   360.0    0.00   -1.50   -2.50"]
    return [
        line("", "START OF ANTENNA"),
        line(f"{name:<20}{serial:<20}", "TYPE / SERIAL NO"),
        line("ROBOT               SOMEBODY                 2    01-JAN-20", "METH / BY / # / DATE"),
        line("   180.0", "DAZI"),
        line("     0.0  60.0  30.0", "ZEN1 / ZEN2 / DZEN"),
        line(f"{count:6d}", "# OF FREQUENCIES"),
        line("a comment", "COMMENT"),
        *frequency("G01", "      1.00     -2.00     70.25", rows),
        *frequency("R02", "-100.00000200.00000      3.00", rows),
        *RMS,
        line("", "END OF ANTENNA"),
    ]


SATELLITE = [
    line("", "START OF ANTENNA"),
    line("BLOCK IIA           G01                 G032      1992-079A", "TYPE / SERIAL NO"),
    line("", "END OF ANTENNA"),
]


def text(*antennas: list[str]) -> str:
    return "\n".join(sum(antennas, HEADER)) + "\n"


def test_columns_units_and_frame() -> None:
    """Millimetres north, east, up become metres east, north, up; fields that touch are told apart by their columns; the grid is whole."""
    found = AntexFile(text(SATELLITE, antenna())).find("TRM1.00", "TZGD")
    assert found is not None
    assert (found.zenith_step_deg, found.azimuth_step_deg, [band.frequency for band in found.bands]) == (30.0, 180.0, ["G01", "R02"])
    assert found.bands[0].offset_enu_m == pytest.approx((-0.002, 0.001, 0.07025))
    assert found.bands[1].offset_enu_m == pytest.approx((0.2, -0.1, 0.003))
    expected_mm = [[0.0, -1.5, -2.5], [0.0, -0.5, -1.5], [0.0, -1.5, -2.5]]
    assert found.bands[0].variation_m == pytest.approx(np.array(expected_mm) * 1e-3)


def test_names_are_those_of_receiver_antennas() -> None:
    """Satellite antennas are passed over; a type without radome in the file has NONE."""
    file = AntexFile(text(SATELLITE, antenna(), antenna("NOV1")))
    assert file.names == (("TRM1.00", "TZGD"), ("NOV1", "NONE"))
    assert file.find("TRM1.00", "NONE") is None
    assert file.find("BLOCK IIA", "NONE") is None


def test_without_azimuths_the_mean_is_taken() -> None:
    """DAZI 0 has one row, NOAZI."""
    body = [line("     0.0", "DAZI") if "DAZI" in row else row for row in antenna(rows=GRID[:1])]
    found = AntexFile(text(body)).find("TRM1.00", "TZGD")
    assert found is not None
    assert found.bands[0].variation_m == pytest.approx(np.array([[0.0, -0.001, -0.002]]))


def test_the_antenna_of_a_serial_number_goes_before_its_type() -> None:
    """Own serial, else the type's mean; a lone individual calibration stands for its type."""
    mean, first, second = antenna(), antenna(serial="1001"), antenna(serial="1002")
    both = AntexFile(text(first, mean, second))
    serials = [found.serial for asked in ("1002", "7", "") if (found := both.find("TRM1.00", "TZGD", asked))]
    assert serials == ["1002", "", ""]
    assert [x.serial for x in AntexFile(text(first))] == ["1001"]
    lone = AntexFile(text(first)).find("TRM1.00", "TZGD")
    assert lone is not None
    assert lone.serial == "1001"
    assert AntexFile(text(first, second)).find("TRM1.00", "TZGD", "7") is None


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "ANTEX VERSION"),
        ("\n".join([HEADER[0], line("R" + " " * 19 + "AOAD/M_T", "PCV TYPE / REFANT"), *antenna()]), "absolute"),
        (text(antenna()[:-1]), "no end"),
    ],
    ids=["nothing", "relative", "cut"],
)
def test_files_that_are_refused(content: str, says: str) -> None:
    """No ANTEX, relative calibrations, an antenna that does not end."""
    with pytest.raises(FormatError, match=says):
        AntexFile(content)


@pytest.mark.parametrize(
    ("damaged", "says"),
    [
        (antenna(count=3), "2 frequencies"),
        (antenna(rows=GRID), "2 rows of 3"),
        (antenna(rows=[*GRID, "   360.0    0.00   -1.50"]), "no number"),
        (antenna(rows=[*GRID, "   360.0    0.00   -1.50     nan"]), "not finite"),
        ([line("   100.0", "DAZI") if "DAZI" in row else row for row in antenna()], "grid to 360"),
        ([row.replace("  30.0", "   0.0") if "ZEN1" in row else row for row in antenna()], "grid to 60"),
        ([row for row in antenna() if "NORTH" not in row], "NORTH"),
    ],
    ids=["count", "azimuth missing", "short row", "nan", "azimuth step", "zenith step", "no offset"],
)
def test_a_damaged_antenna_is_named_and_harms_no_other(damaged: list[str], says: str) -> None:
    """The fault is told when that antenna is asked for; the others of the file are there."""
    file = AntexFile(text(antenna("NOV1"), damaged))
    assert file.find("NOV1", "NONE") is not None
    with pytest.raises(FormatError, match=f"TRM1.00.*{says}"):
        file.find("TRM1.00", "TZGD")


@given(st.data())
def test_any_damage_is_a_format_error(data: st.DataObject) -> None:
    """Whatever bytes are changed, cut or put in, nothing but FormatError is raised."""
    whole = bytearray(text(SATELLITE, antenna()).encode())
    for _ in range(data.draw(st.integers(1, 5))):
        place = data.draw(st.integers(0, len(whole) - 1))
        whole[place : place + data.draw(st.integers(0, 90))] = data.draw(st.binary(max_size=9))
        if not whole:
            break
    try:
        calibrations = list(AntexFile(bytes(whole)))
    except FormatError:
        return
    for calibration in calibrations:
        assert all(np.isfinite(band.variation_m).all() for band in calibration.bands)


@given(
    st.lists(st.integers(-99999, 99999), min_size=3, max_size=3),
    st.lists(st.lists(st.integers(-9999, 9999), min_size=4, max_size=4), min_size=4, max_size=4),
)
def test_what_is_written_is_read(offset: list[int], grid: list[list[int]]) -> None:
    """Names, steps and values to a hundredth of a millimetre survive writing and reading."""
    variation_m = np.array([*grid, grid[0]]) * 1e-5
    east_m, north_m, up_m = (value * 1e-5 for value in offset)
    given_one = AntennaCalibration("LEIAR25.R3", "LEIT", "42", 30.0, 90.0, (BandCalibration("E05", (east_m, north_m, up_m), variation_m),))
    (found,) = AntexFile(write_antex([given_one], ["some comment"]))
    assert (found.antenna, found.radome, found.serial) == ("LEIAR25.R3", "LEIT", "42")
    assert (found.zenith_step_deg, found.azimuth_step_deg) == (30.0, 90.0)
    assert found.bands[0].offset_enu_m == pytest.approx((east_m, north_m, up_m), abs=1e-9)
    assert found.bands[0].variation_m == pytest.approx(variation_m, abs=1e-9)
