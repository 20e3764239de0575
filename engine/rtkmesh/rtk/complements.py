"""Base epochs that are not whole: RTCM 3 sends each system by itself, and lost messages leave an epoch without one."""

from collections import deque
from collections.abc import Iterable
from itertools import islice
from typing import Final

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM
from rtkmesh.rtk.bookkeeping import systems_of

COMPLEMENT_S: Final = 10.0  # how much older a base epoch may be that gives a system which the newest lacks


class BaseEpochs:
    """The newest base epochs."""

    def __init__(self) -> None:
        self._epochs: deque[Epoch] = deque()  # in rising order of time

    def before(self, base: Epoch) -> Iterable[Epoch]:
        """Remember a base epoch; return those before it, newest first."""
        epochs = self._epochs
        if not epochs or epochs[-1] is not base:
            while epochs and base.time - epochs[-1].time <= 0.0:
                epochs.pop()
            while epochs and base.time - epochs[0].time > COMPLEMENT_S:
                epochs.popleft()
            epochs.append(base)
        return islice(reversed(epochs), 1, None)


def complemented(base: Epoch, missing: int, earlier: Iterable[Epoch]) -> list[Epoch]:
    """Return the base epoch and, from ``earlier`` ones, newest first, the systems that are ``missing`` (a bit each)."""
    parts = [base]
    for other in earlier if missing else ():
        if found := missing & systems_of(other.satellite):
            parts.append(other.take((found >> (other.satellite // SATELLITES_PER_SYSTEM)) & 1 != 0))
            missing &= ~found
    return parts
