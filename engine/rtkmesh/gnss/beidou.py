"""What is different about some satellites of BeiDou."""

from typing import Final

from rtkmesh.gnss.signals import BEIDOU, SATELLITES_PER_SYSTEM

GEOSTATIONARY: Final = frozenset((1, 2, 3, 4, 5, 59, 60, 61, 62, 63))  # numbers (BDS-SIS-ICD B1I 3.0, 3.1)


def is_geostationary(satellite: int) -> bool:
    """Return whether this is the number (of all systems) of a geostationary satellite of BeiDou, with a clock of its own in receivers."""
    system, number = divmod(satellite, SATELLITES_PER_SYSTEM)
    return system == BEIDOU and number in GEOSTATIONARY
