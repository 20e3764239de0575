"""Orders to a receiver and its answers: said, waited for, said again. Knows no port and no clock.

A receiver's answers are whole UBX frames or lines of text; ``TextLines`` finds the latter among whatever else it sends.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from rtkmesh.codecs.messages import Frame

Heard = Frame | str
FIRST_PATIENCE_S: Final = 1.0
LAST_PATIENCE_S: Final = 4.0
ATTEMPTS: Final = 4
_LONGEST_LINE: Final = 2000
_LINE: Final = re.compile(rb"[\t\x20-\x7e]{2,2000}(?=\r?\n)")


@dataclass(frozen=True, slots=True)
class Answer:
    """What a receiver says to an order: whether it takes it, in its words, and values that were asked for by name."""

    accepted: bool
    text: str = ""
    values: dict[str, float] = field(default_factory=dict[str, float])


@dataclass(frozen=True, slots=True)
class Order:
    """Something to say. ``judge`` returns the answer in what was heard, None when that is about something else.

    ``needed`` False: others follow even where it is refused or not answered.
    """

    said: str
    data: bytes
    judge: Callable[[Heard], Answer | None]
    needed: bool = True
    attempts: int = ATTEMPTS


@dataclass(frozen=True, slots=True)
class Told:
    """An order with what became of it; ``answer`` None: it was not answered."""

    order: Order
    answer: Answer | None


class Conversation:
    """Says orders one after the other, each until it is answered, with growing patience; the first that fails ends it."""

    def __init__(self, orders: Sequence[Order], send: Callable[[bytes], bool]) -> None:
        self._orders, self._send = list(orders), send
        self._attempt, self._due_s = 0, 0.0
        self.told: list[Told] = []
        self.failure = ""

    @property
    def ended(self) -> bool:
        """Whether nothing more will be said."""
        return bool(self.failure) or len(self.told) == len(self._orders)

    def tick(self, now_s: float) -> None:
        """Say what is due; an order that cannot be sent (nothing is connected, a full queue) waits without counting."""
        if self.ended or now_s < self._due_s:
            return
        order = self._orders[len(self.told)]
        if self._attempt >= order.attempts:
            self._settle(order, None)
            self.tick(now_s)
        elif self._send(order.data):
            self._due_s = now_s + min(LAST_PATIENCE_S, FIRST_PATIENCE_S * 2.0**self._attempt)
            self._attempt += 1

    def hear(self, heard: Heard, now_s: float) -> None:
        """Take what the receiver says; goes on at once when it is the answer."""
        if self.ended or not self._attempt:
            return
        order = self._orders[len(self.told)]
        answer = order.judge(heard)
        if answer is not None:
            self._settle(order, answer)
            self.tick(now_s)

    def _settle(self, order: Order, answer: Answer | None) -> None:
        self.told.append(Told(order, answer))
        if order.needed and answer is None:
            self.failure = f"{order.said}: no answer after {order.attempts} attempts"
        elif order.needed and answer is not None and not answer.accepted:
            self.failure = f"{order.said}: refused{f' ({answer.text})' if answer.text else ''}"
        self._attempt, self._due_s = 0, 0.0


class TextLines:
    """Finds lines of printable text in a stream of anything."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[str]:
        """Return the lines that are whole with these further bytes."""
        data = self._rest + data
        end = data.rfind(b"\n") + 1
        self._rest = data[end:][-_LONGEST_LINE:]
        return [line.decode("ascii") for line in _LINE.findall(data[:end])]
