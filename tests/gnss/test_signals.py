"""Satellite and signal numbers: invertible, ordered, with the carriers of RINEX 3.05."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.signals import (
    MAX_SATELLITE,
    MAX_SIGNAL,
    NO_CHANNEL,
    SYSTEMS,
    band_of,
    carrier_hz,
    satellite_id,
    satellite_number,
    signal_code,
    signal_number,
    system_of,
)

satellites = st.builds(lambda system, number: f"{system}{number:02d}", st.sampled_from(SYSTEMS), st.integers(1, 63))
codes = st.builds(lambda band, attribute: f"{band}{attribute}", st.integers(1, 9), st.sampled_from("ABCDEILMNPQSWXYZ"))


@given(satellites)
def test_satellite_ids_come_back(name: str) -> None:
    number = satellite_number(name)
    assert satellite_id(number) == name
    assert 0 < number < MAX_SATELLITE
    assert SYSTEMS[system_of(number)] == name[0]


@given(codes)
def test_signal_codes_come_back(code: str) -> None:
    number = signal_number(code)
    assert signal_code(number) == code
    assert 0 < number < MAX_SIGNAL
    assert band_of(number) == int(code[0])


@pytest.mark.parametrize("name", ["", "G", "X01", "G64", "G00", "Gx1", "5G"])
def test_what_is_no_satellite_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="satellite id"):
        satellite_number(name)


@pytest.mark.parametrize("code", ["", "1", "C1", "1c", "1CC", "1-"])
def test_what_is_no_signal_is_refused(code: str) -> None:
    with pytest.raises(ValueError, match="signal code"):
        signal_number(code)


@pytest.mark.parametrize(
    ("satellite", "code", "channel", "mhz"),
    [
        ("G01", "1C", NO_CHANNEL, 1575.42), ("G01", "2W", NO_CHANNEL, 1227.60), ("G01", "5Q", NO_CHANNEL, 1176.45),
        ("E01", "1X", NO_CHANNEL, 1575.42), ("E01", "7Q", NO_CHANNEL, 1207.14), ("E01", "8X", NO_CHANNEL, 1191.795),
        ("E01", "6C", NO_CHANNEL, 1278.75), ("C01", "2I", NO_CHANNEL, 1561.098), ("C20", "1P", NO_CHANNEL, 1575.42),
        ("C01", "6I", NO_CHANNEL, 1268.52), ("C20", "5P", NO_CHANNEL, 1176.45), ("C20", "7I", NO_CHANNEL, 1207.14),
        ("J02", "6X", NO_CHANNEL, 1278.75), ("I03", "9A", NO_CHANNEL, 2492.028), ("S33", "1C", NO_CHANNEL, 1575.42),
        ("R01", "1C", 1, 1602.5625), ("R10", "1C", -7, 1598.0625), ("R10", "2C", -7, 1242.9375), ("R21", "3Q", NO_CHANNEL, 1202.025),
        ("R01", "1C", NO_CHANNEL, 0.0),
    ],
)  # fmt: skip
def test_carriers(satellite: str, code: str, channel: int, mhz: float) -> None:
    """RINEX 3.05 tables 4 to 10; a GLONASS FDMA signal without its channel has none."""
    assert carrier_hz(satellite_number(satellite), signal_number(code), channel) == pytest.approx(mhz * 1e6, abs=0.5)


def test_numbers_sort_as_ids_within_the_order_of_systems() -> None:
    names = ["G01", "G32", "R01", "E36", "C05", "C63", "J01", "S20", "I07"]
    assert sorted(names, key=satellite_number) == names
    assert sorted(["1C", "1X", "2I", "2W", "7Q"], key=signal_number) == ["1C", "1X", "2I", "2W", "7Q"]
