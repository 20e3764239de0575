"""Who guesses passwords waits: longer with every wrong one, and for a while is not listened to at all."""

import hmac
from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

FIRST_PAUSE_S: Final = 0.25
LONGEST_PAUSE_S: Final = 4.0
TRIES: Final = 5  # of one connection
LOCKED_AFTER: Final = 20  # wrong ones of one address within the time of memory
MEMORY_S: Final = 300.0
MAXIMUM_ADDRESSES: Final = 256


@dataclass(slots=True)
class _Guesser:
    wrong: int
    last_s: float


class Throttle:
    """The wrong passwords of each address. Not thread-safe: its owner holds a lock."""

    def __init__(self) -> None:
        self._guessers: OrderedDict[str, _Guesser] = OrderedDict()

    def locked(self, address: str, now_s: float) -> bool:
        """Return whether an address has guessed too often."""
        guesser = self._guessers.get(address)
        return guesser is not None and guesser.wrong >= LOCKED_AFTER and now_s - guesser.last_s < MEMORY_S

    def wrong(self, address: str, now_s: float) -> float:
        """Note a wrong password; return for how many seconds its answer is held back."""
        guesser = self._guessers.pop(address, None)
        if guesser is None or now_s - guesser.last_s >= MEMORY_S:
            guesser = _Guesser(0, now_s)
        guesser.wrong, guesser.last_s = guesser.wrong + 1, now_s
        self._guessers[address] = guesser
        while len(self._guessers) > MAXIMUM_ADDRESSES:
            self._guessers.popitem(last=False)
        return min(FIRST_PAUSE_S * 2.0 ** min(guesser.wrong - 1, 10), LONGEST_PAUSE_S)

    def right(self, address: str) -> None:
        """Forget the wrong passwords of who has said the right one."""
        self._guessers.pop(address, None)


def is_password(given: str, password: str) -> bool:
    """Return whether the password is right, in a time that does not tell how much of it is."""
    return hmac.compare_digest(given.encode(), password.encode())
