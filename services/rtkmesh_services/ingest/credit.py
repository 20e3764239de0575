"""Pacing of replays by their consumers: nothing is sent that they could not take, so nothing is ever dropped.

A replay begins when every consumer has said that it is ready, and is never further ahead of the slowest one than a window of
messages, unless that consumer says that it needs the stream up to a later time. A consumer that has died is not waited for, or only
for ``patience_s``: in a replay without clock its supervisor shall find something left to play when it is back. It then counts
from there.
"""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import inf
from time import monotonic

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.observation import CREDIT_WINDOW, Credit

_POLL_S = 0.1


@dataclass(slots=True)
class _Consumer:
    start_id: str = ""
    taken: int = -1
    wanted: GpsTime | None = None
    alive: bool = False
    died_s: float = -inf


class CreditGate:
    """Lets a replay's thread pass when all consumers can take more. Thread-safe."""

    def __init__(self, consumers: Iterable[str], window: int = CREDIT_WINDOW, patience_s: float = 0.0) -> None:
        self._consumers = {name: _Consumer() for name in consumers}
        self._window, self._patience_s = window, patience_s
        self._sent = -1
        self._changed = threading.Condition()

    def credit(self, message: Credit) -> None:
        """Take what a consumer says; consumers that are not in the deployment are not waited for."""
        with self._changed:
            consumer = self._consumers.get(message.consumer)
            if consumer is None:
                return
            if consumer.start_id != message.consumer_start_id:
                consumer.start_id, consumer.taken = message.consumer_start_id, self._sent
            consumer.alive = True
            consumer.taken = max(consumer.taken, message.sequence)
            consumer.wanted = None if message.wanted is None else GpsTime(*message.wanted)
            self._changed.notify_all()

    def gone(self, consumer: str) -> None:
        """A consumer's liveliness token has vanished."""
        with self._changed:
            if consumer in self._consumers:
                self._consumers[consumer].alive = False
                self._consumers[consumer].died_s = monotonic()
                self._changed.notify_all()

    def wait_ready(self, stopping: threading.Event) -> bool:
        """Wait until every consumer has spoken; False when the process is to end."""
        return self._wait(stopping, lambda: all(consumer.start_id for consumer in self._consumers.values()))

    def wait(self, sequence: int, time: GpsTime, stopping: threading.Event) -> bool:
        """Wait until message ``sequence``, an epoch of ``time``, may be sent; False when the process is to end."""
        if not self._wait(stopping, lambda: all(self._may(consumer, sequence, time) for consumer in self._consumers.values())):
            return False
        self._sent = sequence
        return True

    def missing(self) -> list[str]:
        """Return the consumers that have not spoken yet."""
        with self._changed:
            return [name for name, consumer in self._consumers.items() if not consumer.start_id]

    def _may(self, consumer: _Consumer, sequence: int, time: GpsTime) -> bool:
        if not consumer.alive:
            return monotonic() - consumer.died_s >= self._patience_s
        if sequence - consumer.taken <= self._window:
            return True
        return consumer.wanted is not None and time <= consumer.wanted

    def _wait(self, stopping: threading.Event, condition: Callable[[], bool]) -> bool:
        with self._changed:
            while not stopping.is_set():
                if condition():
                    return True
                self._changed.wait(_POLL_S)
        return False
