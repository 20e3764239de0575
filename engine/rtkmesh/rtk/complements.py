"""Base epochs that are not whole: RTCM 3 sends each system by itself, and lost messages leave an epoch without one."""

from collections.abc import Iterable
from typing import Final

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM
from rtkmesh.rtk.bookkeeping import systems_of

COMPLEMENT_S: Final = 10.0  # how much older a base epoch may be that gives a system which the newest lacks


class BaseEpochs:
    """The newest base epochs."""

    def __init__(self) -> None:
        self._epochs: list[Epoch] = []

    def before(self, base: Epoch) -> Iterable[Epoch]:
        """Remember a base epoch; return those before it, newest first."""
        if not self._epochs or self._epochs[-1] is not base:
            self._epochs = [b for b in self._epochs if 0.0 < base.time - b.time <= COMPLEMENT_S] + [base]
        return reversed(self._epochs[:-1])


def complemented(rover: Epoch, base: Epoch, earlier: Iterable[Epoch]) -> list[Epoch]:
    """Return the base epoch and, from ``earlier`` ones, newest first, the systems that it lacks and the rover has."""
    parts = [base]
    missing = systems_of(rover.satellite) & ~systems_of(base.satellite)
    for other in earlier if missing else ():
        if found := missing & systems_of(other.satellite):
            parts.append(other.take((found >> (other.satellite // SATELLITES_PER_SYSTEM)) & 1 != 0))
            missing &= ~found
    return parts
