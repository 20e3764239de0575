"""Geostationary satellites of BeiDou: the list of the codecs against the test of the kernels."""

from rtkmesh.gnss.beidou import is_geostationary
from rtkmesh.gnss.signals import BEIDOU, SATELLITES_PER_SYSTEM, satellite_number
from rtkmesh.rtk import matching


def test_the_list_says_what_the_kernel_says() -> None:
    numbers = [number for number in range(7 * SATELLITES_PER_SYSTEM) if number % SATELLITES_PER_SYSTEM]
    assert [is_geostationary(number) for number in numbers] == [bool(matching.is_geostationary(number)) for number in numbers]
    assert sum(map(is_geostationary, numbers)) == 10
    assert is_geostationary(satellite_number("C03"))
    assert not is_geostationary(satellite_number("C08"))
    assert not is_geostationary(3)
    assert all(number // SATELLITES_PER_SYSTEM == BEIDOU for number in numbers if is_geostationary(number))
