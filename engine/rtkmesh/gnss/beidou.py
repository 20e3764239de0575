"""What is different about some satellites of BeiDou."""

from rtkmesh._jit import kernel_in_place
from rtkmesh.gnss.ephemeris import NavigationMessage
from rtkmesh.gnss.signals import BEIDOU, SATELLITES_PER_SYSTEM


@kernel_in_place
def is_geostationary(satellite: int) -> bool:
    """Return whether this is the number (of all systems) of a geostationary satellite of BeiDou (BDS-SIS-ICD B1I 3.0, 3.1).

    They have a clock of their own in receivers, and an orbit and a message of another kind.
    """
    number = satellite % SATELLITES_PER_SYSTEM
    return satellite // SATELLITES_PER_SYSTEM == BEIDOU and (0 < number <= 5 or number >= 59)


def message_on_b1i(satellite: int) -> NavigationMessage:
    """Return the message that a satellite of BeiDou sends on B1I: D2 if it is geostationary."""
    return NavigationMessage.D2 if is_geostationary(satellite) else NavigationMessage.D1
