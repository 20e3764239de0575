"""Geostationary satellites of BeiDou (BDS-SIS-ICD B1I 3.0: 1 to 5; 3.1: 59 to 63)."""

from rtkmesh.gnss.beidou import is_geostationary, message_on_b1i
from rtkmesh.gnss.ephemeris import NavigationMessage
from rtkmesh.gnss.signals import MAX_SATELLITE, satellite_id, satellite_number


def test_ten_satellites_of_one_system_are_geostationary() -> None:
    found = [satellite_id(number) for number in range(MAX_SATELLITE) if is_geostationary(number)]
    assert found == ["C01", "C02", "C03", "C04", "C05", "C59", "C60", "C61", "C62", "C63"]


def test_these_send_the_second_message() -> None:
    assert message_on_b1i(satellite_number("C05")) is NavigationMessage.D2
    assert message_on_b1i(satellite_number("C06")) is NavigationMessage.D1
    assert message_on_b1i(satellite_number("C58")) is NavigationMessage.D1
