"""Orders to the selected base's ingest: asked in a thread of their own, so that control's loop waits for nobody."""

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from rtkmesh_schemas.command import Reply
from rtkmesh_services.control.flockwave.desk import Respond
from rtkmesh_services.control.flockwave.survey import SurveyError, SurveySettings
from rtkmesh_services.runtime.bus import Bus
from rtkmesh_services.runtime.calls import call

DEADLINE_S: Final = 1.0
MAXIMUM_WAITING: Final = 16
CALLER: Final = "flockwave"


@dataclass(frozen=True, slots=True)
class Order:
    """Settings that a base is to follow; ``respond`` takes what is answered to who asked."""

    preset: str
    ingest: str
    settings: SurveySettings
    respond: Respond


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of an order."""

    order: Order
    reply: Reply


class Orders:
    """``tell`` is called with each outcome, in the thread."""

    def __init__(self, bus: Bus, tell: Callable[[Outcome], Any]) -> None:
        self._bus, self._tell = bus, tell
        self._waiting: queue.Queue[Order | None] = queue.Queue(MAXIMUM_WAITING)
        self._thread = threading.Thread(target=self._run, daemon=True, name="flockwave-orders")

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def put(self, order: Order) -> None:
        """Take an order; SurveyError where too many wait."""
        try:
            self._waiting.put_nowait(order)
        except queue.Full:
            raise SurveyError("too many survey settings wait for the base") from None

    def close(self) -> None:
        """End after the order that is under way."""
        while True:
            try:
                self._waiting.put_nowait(None)
                return
            except queue.Full:
                self._waiting.get_nowait()

    def _run(self) -> None:
        while (order := self._waiting.get()) is not None:
            op, arguments = order.settings.order()
            [reply] = call(self._bus, order.ingest, op, arguments, DEADLINE_S, caller=CALLER)
            self._tell(Outcome(order, reply))
