"""Status records and marks: their fields, in both dialects, and what is not known."""

from math import nan
from typing import Any

import msgspec
import pytest
from tests.texts.solutions import table
from tests.texts.test_lines import SOLUTION, vector_to_ecef

from rtkmesh_services.texts import TextOptions, TextWriter

STAT = TextOptions(format="stat", status="residual")
SKY = table(
    [
        ("G01", "1C", 7, 10.0, 60.0, 45.4),
        ("G01", "2W", 32, 10.0, 60.0, 30.0),
        ("S20", "1C", 2, 20.0, 20.0, 40.0),
        ("R03", "1C", 0, 1.0, 2.0, 3.0),
    ],
    code_residual_m=[0.5, nan, 0.25, 0.0],
    phase_residual_m=[-0.001, nan, 0.0, 0.0],
    ambiguity_cyc=[12345.678, nan, 0.0, 0.0],
    ambiguity_variance_cyc2=[0.01, nan, 0.0, 0.0],
    lock_epochs=[77, -1, 3, 0],
    rejects=[0, 2, 0, 0],
    slips=[1, 0, 0, 0],
    ionosphere_m=[0.2, 0.2, nan, nan],
)


def records(options: TextOptions = STAT, satellites: Any = SKY, **changes: Any) -> list[list[str]]:
    """Return the records of an epoch, in fields."""
    text = TextWriter(options).text(msgspec.structs.replace(SOLUTION, **changes), satellites)
    assert "\r" not in text
    return [line.split(",") for line in text.splitlines()]


def test_records_and_their_fields() -> None:
    """A fix with a moving filter: the order of records and the number of fields of each, as RTKLIB documents them."""
    found = records(
        float_position_ecef_m=(1.0, 2.0, 3.0), float_velocity_ecef_mps=vector_to_ecef(1.0, 2.0, 3.0),
        float_acceleration_ecef_mps2=vector_to_ecef(0.1, 0.2, 0.3), acceleration_ecef_mps2=vector_to_ecef(0.4, 0.5, 0.6),
        clocks_s=(1e-6, 2e-6, nan, 4e-6, 1e-6, nan, 1e-6), zenith_delays_m=(2.31, 2.3), glonass_slopes_m=(0.005625, 0.00875),
    )  # fmt: skip
    assert [record[0] for record in found] == [
        "$POS", "$VELACC", "$CLK", "$ION", "$TROP", "$TROP", "$HWBIAS", "$HWBIAS", "$SAT", "$SAT", "$SAT",
    ]  # fmt: skip
    assert [len(record) for record in found] == [10, 16, 11, 9, 7, 7, 7, 7, 20, 20, 20]
    assert found[0][1:] == ["2149", "475219.000", "1", "1.0000", "2.0000", "3.0000", *(f"{v:.4f}" for v in SOLUTION.position_ecef_m)]
    assert found[1][4:] == [
        "1.0000", "2.0000", "3.0000", "0.10000", "0.20000", "0.30000", "1.0000", "-2.0000", "0.5000", "0.40000", "0.50000", "0.60000",
    ]  # fmt: skip
    assert found[2][4:] == ["1", "1000.000", "1000.000", "0.000", "3000.000", "0.000", "0.000"]
    assert found[4][4:] == ["1", "2.3100", "0.0000"]
    assert found[6][4:] == ["1", "0.0100", "0.0000"]
    assert found[7][4:] == ["2", "0.0200", "0.0000"]


def test_satellites() -> None:
    """Those in the solution: direction, residuals, fix, slip, lock, ambiguity; SBAS by its PRN, frequencies by RTKLIB's numbers."""
    rows = [record[1:] for record in records() if record[0] == "$SAT"]
    assert ",".join(rows[0]) == "2149,475219.000,G01,1,10.0,60.0,0.5000,-0.0010,1,45,2,0,77,0,1,0,12345.68,0.010000,0.00000"
    assert ",".join(rows[1]) == "2149,475219.000,G01,2,10.0,60.0,0.0000,0.0000,0,30,0,2,0,0,0,2,0.00,0.000000,0.00000"
    assert rows[2][2:4] == ["120", "1"]
    assert len(rows) == 3


def test_ionosphere_is_vertical() -> None:
    """A delay along the ray at 60 degrees is 1.136 times that at the zenith (a layer at 350 km)."""
    [ion] = [record for record in records() if record[0] == "$ION"]
    assert ion[1:6] == ["2149", "475219.000", "1", "G01", "10.0"]
    assert float(ion[7]) == pytest.approx(0.2 / 1.13568, abs=1e-4)


def test_dialect_of_242() -> None:
    """Four clocks, and satellites end with the rejects."""
    found = records(TextOptions(format="stat", status="residual", dialect="2.4"))
    assert [len(record) for record in found if record[0] in ("$CLK", "$SAT")] == [9, 17, 17, 17]


def test_level_of_states_has_no_satellites() -> None:
    """At level state residuals are left out."""
    assert [record[0] for record in records(TextOptions(format="stat"))] == ["$POS", "$VELACC", "$CLK", "$ION"]


def test_a_message_of_satellites_is_written_once_with_its_time() -> None:
    """Satellites may come slower than solutions; those of a later epoch wait for it."""
    writer = TextWriter(STAT)
    assert "$SAT" not in writer.text(msgspec.structs.replace(SOLUTION, tow_s=475218.8), SKY)
    first, second = (writer.text(msgspec.structs.replace(SOLUTION, tow_s=tow_s), SKY) for tow_s in (475219.2, 475219.4))
    assert first.count("$SAT,2149,475219.000,") == 3
    assert "$SAT" not in second


def test_without_a_moving_filter() -> None:
    """A single point has its position twice named (fixed: 0) and the velocity by Dopplers only; unknown numbers are 0."""
    position, motion, clocks = records(satellites=None, status=5, velocity_ecef_mps=(nan,) * 3)
    assert position[7:] == ["0.0000"] * 3
    assert [float(value) for value in motion[4:]] == [0.0] * 12
    assert clocks[5:] == ["0.000"] * 6


MARK = {
    "name": "P1", "comment": "corner, north", "week": 2149, "tow_s": 475219.0, "status": 1, "lat_deg": 35.339325773,
    "lon_deg": 139.522173121, "height_m": 65.7169, "position_ecef_m": [-3962108.67, 3381309.57, 3668678.64],
}  # fmt: skip


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (TextOptions(), "% MARK: P1,2021/03/19 12:00:19.000,35.339325773,139.522173121,65.7169,1,corner, north\r\n"),
        (TextOptions(dialect="2.4"), "% MARK: P1,2021/03/19 12:00:19.000,35.339325773,139.522173121,65.7169,1,corner, north\n"),
        (TextOptions(format="stat"), "$MARK,2149,475219.000,1,-3962108.6700,3381309.5700,3668678.6400,P1,corner, north\n"),
        (
            TextOptions(format="nmea"),
            "$GPTXT,01,01,02,MARK:P1,2021/03/19 12:00:19.000,35.339325773,139.522173121,65.7169,1,corner, north*7C\r\n",
        ),
    ],
)
def test_marks(options: TextOptions, text: str) -> None:
    """A mark in each kind of format, as rtksvrmark writes it."""
    assert TextWriter(options).mark(MARK).decode() == text


def test_marks_are_one_line() -> None:
    """Words of users cannot end a line or a sentence; what is missing is 0 or empty."""
    hostile = {"name": "a\r\n$GPGGA", "comment": "*00\x00ü"}
    for options in (TextOptions(), TextOptions(format="nmea"), TextOptions(format="stat")):
        text = TextWriter(options).mark(hostile)
        assert text.count(b"\n") == 1
        assert text.endswith(b"\n")
        assert TextWriter(options).mark({"tow_s": nan, "position_ecef_m": None})
    sentence = TextWriter(TextOptions(format="nmea")).mark(hostile)
    assert (sentence.count(b"$"), sentence.count(b"*")) == (1, 1)
