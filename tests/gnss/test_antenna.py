"""Names of antennas."""

import pytest

from rtkmesh.gnss.antenna import antenna_name


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("LEIAR25.R3      LEIT", ("LEIAR25.R3", "LEIT")),
        ("leiar25.r3 leit", ("LEIAR25.R3", "LEIT")),
        ("TRM29659.00", ("TRM29659.00", "NONE")),
        ("TRM29659.00         ", ("TRM29659.00", "NONE")),
        ("AOAD/M_T        NONE", ("AOAD/M_T", "NONE")),
        ("SOME PATCH", ("SOME PATCH", "NONE")),
        ("", ("", "NONE")),
    ],
)
def test_type_and_radome(text: str, expected: tuple[str, str]) -> None:
    """IGS columns, blanks and case as people and receivers write them; no radome is NONE."""
    assert antenna_name(text) == expected
