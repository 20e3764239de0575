"""Orders to solvers to use another base: asked in a thread of their own, once, and again where that may help."""

import queue
import threading
from dataclasses import dataclass
from typing import Any, Final

from rtkmesh_schemas.command import Code, Reply
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.status import Level, ServiceStatus
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.service import Context

DEADLINE_S: Final = 2.0
AGAIN_S: Final = 2.0
_GONE: Final = (Code.ABSENT, Code.HUNG, Code.REFUSED, Code.UNREACHABLE)  # nobody has decided anything


@dataclass(frozen=True, slots=True)
class Answered:
    """What a solver has answered."""

    solver: str
    base: str
    reply: Reply


@dataclass(slots=True)
class _Order:
    base: str
    start_id: str
    at_s: float
    open: bool = True  # not answered yet
    refused: bool = False
    early: bool = False  # it was no time for it


class BaseOrders:
    """Asks solvers for ``base``. ``ask`` and ``took`` are for the work loop."""

    def __init__(self, context: Context, lane: str) -> None:
        self._context, self._lane = context, lane
        self._orders: dict[str, _Order] = {}
        self._waiting: queue.SimpleQueue[tuple[str, dict[str, Any]] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def ask(self, solver: str, arguments: dict[str, Any], status: ServiceStatus, now_s: float, *, again: bool) -> None:
        """Ask a solver that uses another base, unless it is on its way; after a time-out only ``again`` where the base delivers by now."""
        base, order = str(arguments["id"]), self._orders.get(solver)
        new = order is None or order.base != base or order.start_id != status.start_id
        if not new and order is not None:
            listening = status.data.get("next_base") == base
            if order.open or listening or now_s - order.at_s < AGAIN_S or order.refused or not (again or order.early):
                return
        self._orders[solver] = _Order(base, status.start_id, now_s)
        self._send(solver, arguments)

    def took(self, item: Any, now_s: float) -> bool:
        """Take an answer; False when the item is none."""
        if not isinstance(item, Answered):
            return False
        order = self._orders.get(item.solver)
        if order is None or order.base != item.base:
            return True
        order.open, order.at_s, order.early = False, now_s, item.reply.code is Code.WRONG_STATE
        if item.reply.code in _GONE:
            del self._orders[item.solver]
        elif item.reply.code is not Code.WRONG_STATE and not item.reply.ok:  # a wrong state passes
            order.refused = True
            text = f"{item.solver} does not take base {item.base}: {item.reply.message}"
            self._context.event(Level.ERROR, "base_refused", text, solver=item.solver, base=item.base)
        return True

    def close(self) -> None:
        """Ask nobody any more."""
        self._waiting.put(None)

    def _send(self, solver: str, arguments: dict[str, Any]) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="base-orders", daemon=True)
            self._thread.start()
        self._waiting.put((solver, arguments))

    def _run(self) -> None:
        while (order := self._waiting.get()) is not None:
            solver, arguments = order
            try:
                reply = call(self._context.bus, solver, "base", arguments, DEADLINE_S, caller="control")[0]
            except (ServiceError, SchemaError) as error:
                reply = Reply(ok=False, code=Code.UNREACHABLE, message=str(error))
            self._context.inbox.put(Answered(solver, str(arguments["id"]), reply), lane=self._lane)
