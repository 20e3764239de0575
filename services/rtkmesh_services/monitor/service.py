"""The monitor: the fleet's health as one status, and an event whenever it changes."""

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from rtkmesh_schemas.command import Reply, Request
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.keys import STATUS, Role, stream_of
from rtkmesh_schemas.status import Level, ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.monitor.health import WATCHED, FleetHealth, Health, Verdict
from rtkmesh_services.runtime.bus import Liveliness, Sample
from rtkmesh_services.runtime.service import Context, Report, Service, done

_SETTLE_S: Final = 2.0  # after the start the cached words of all have come


class MonitorService(Service):
    """Listens to every process and says how the fleet is."""

    role: ClassVar[Role] = Role.MONITOR
    operations: ClassVar[Mapping[str, str]] = {"fleet": "the health of every process"}
    reads: ClassVar[frozenset[str]] = frozenset({"fleet"})

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._period_ns = round(context.deployment.monitor[context.id].period_s * 1e9)
        self._health = FleetHealth()
        self._next_ns = context.clock.mono_ns() + round(_SETTLE_S * 1e9)

    def open(self) -> None:
        """Listen to every stream with a nominal rate and to the liveliness of all."""
        for stream in WATCHED:
            self.context.subscribe(stream.expression(), lane="watched", history=stream is STATUS, latest=True)
        self.context.bus.on_live(lambda change: self.context.inbox.put(change, lane="live"))

    def handle(self, item: Any) -> None:
        """Take a message or a change of liveliness."""
        if isinstance(item, Liveliness):
            self._health.live(item.id, item.role, self._now_s(), alive=item.alive)
        elif isinstance(item, Sample) and (found := stream_of(item.key)):
            stream, id_ = found
            if stream is STATUS:
                self._status(item)
            else:
                self._health.heard(stream, id_, item.received_mono_ns * 1e-9)

    def tick(self, now_mono_ns: int) -> None:
        """Look over the fleet once per period."""
        if now_mono_ns < self._next_ns:
            return
        self._next_ns = now_mono_ns + self._period_ns
        for id_, before, now in self._health.check(now_mono_ns * 1e-9):
            self._tell(id_, before, now)

    def command(self, request: Request) -> Reply:
        """Answer ``fleet``."""
        assert request.op in self.operations
        return done("the fleet", fleet=self._health.table(self._now_s()))

    def report(self) -> Report:
        """Return the fleet's health; DEGRADED while anybody needs attention."""
        bad = self._health.bad()
        table = self._health.table(self._now_s())
        reason = "; ".join(f"{id_} {verdict.health}" + (f": {verdict.reason}" if verdict.reason else "") for id_, verdict in bad.items())
        counters = {"processes": len(table), "bad": len(bad)}
        return Report(state=State.DEGRADED if bad else State.RUNNING, reason=reason, counters=counters, data={"fleet": table})

    def _status(self, sample: Sample) -> None:
        try:
            status = decode(ServiceStatus, sample.payload, sample.encoding)
        except SchemaError as error:
            self.context.log.debug("a status that is none on %s: %s", sample.key, error)
            return
        self._health.status(status, sample.received_mono_ns * 1e-9)

    def _tell(self, id_: str, before: Verdict, now: Verdict) -> None:
        if before.health is Health.STARTING and now.health is Health.OK:
            return
        role = self._health.role_of(id_)
        why = f": {now.reason}" if now.reason else ""
        data: dict[str, Any] = {"id": id_, "role": role, "health": str(now.health), "before": str(before.health), "reason": now.reason}
        if now.good:
            self.context.event(Level.INFO, "health_good", f"{role} {id_} is {now.health}" + why, **data)
        else:
            level = Level.ERROR if now.health in (Health.FAILED, Health.GONE) else Level.WARNING
            self.context.event(level, f"health_{now.health}", f"{role} {id_} is {now.health}{why}", **data)

    def _now_s(self) -> float:
        return self.context.clock.mono_ns() * 1e-9


def create(context: Context) -> Service:
    """Return the monitor of ``[monitor.ID]``."""
    return MonitorService(context)
