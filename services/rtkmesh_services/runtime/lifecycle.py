"""The life of a process: STARTING, WARMING, then what its reports say, and its end. All state transitions live here.

``Lifecycle`` is one service with its loop, step by step; ``run_service`` (in ``runtime.process``) is the process around it.
"""

import os
import platform
import threading
from collections.abc import Callable
from math import inf
from typing import Final

import msgspec

import rtkmesh
from rtkmesh_schemas.command import Code
from rtkmesh_schemas.keys import BY_NAME, CMD, LATEST, METRICS, STATUS, STREAMS, Kind, Stream
from rtkmesh_schemas.status import Level, Metrics, Quantiles, ServiceStatus, State
from rtkmesh_schemas.wire import JSON, MSGPACK, encode_json
from rtkmesh_services.runtime.bus import Handle, Query
from rtkmesh_services.runtime.commands import CommandDesk, encoded_as_asked, metric_values, wants_msgpack
from rtkmesh_services.runtime.namesake import Namesake
from rtkmesh_services.runtime.service import Report, Service, refused
from rtkmesh_services.runtime.statistics import RollingQuantiles

HEARTBEAT_NS: Final = 1_000_000_000
_COMMANDS: Final = "command"
_COMMAND_CAPACITY: Final = 64
_HOST: Final = platform.node()


class Lifecycle:
    """One service and its loop. ``start``, then ``step`` until ``ended``, then ``finish``."""

    def __init__(self, service: Service, *, warm_in_thread: bool = True, on_open: Callable[[], object] = int) -> None:
        self.service = service
        self.context = service.context
        self._state, self._reason = State.STARTING, ""
        self._desk = CommandDesk(service, self._status_now, self.end)
        self._namesake = Namesake(self.context)
        self._warm_in_thread, self._on_open = warm_in_thread, on_open
        self._warmed = threading.Event()
        self._warm_error: BaseException | None = None
        self._handles: list[Handle] = []
        self._token: Handle | None = None
        self._heartbeat = 0
        self._published: tuple[State, str] | None = None
        self._started_ns = self._next_tick_ns = self._next_status_ns = self.context.clock.mono_ns()
        self._connected = True
        self.end_reason = ""

    @property
    def ended(self) -> bool:
        """Whether the loop shall not step any more."""
        return self.context.stopping.is_set()

    def end(self, reason: str) -> None:
        """Ask the loop to end. From any thread."""
        self.end_reason = self.end_reason or reason
        self.context.stopping.set()
        self.context.inbox.wake()

    def start(self) -> None:
        """Serve commands and begin to warm."""
        context = self.context
        context.inbox.lane(_COMMANDS, capacity=_COMMAND_CAPACITY, urgent=True, on_drop=self._desk.busy)
        for stream in (stream for stream in (CMD, LATEST) if context.role in stream.owner):
            self._handles.append(context.bus.queryable(stream.key(context.id), lambda query: context.inbox.put(query, lane=_COMMANDS)))
        self._handles += self._namesake.watch()
        self._become(State.WARMING)
        if self._warm_in_thread:
            threading.Thread(target=self._warm, name="warm", daemon=True).start()
        else:
            self._warm()

    def step(self, timeout_s: float | None = None) -> None:
        """Take at most one item, then do what time asks for. Exceptions of the service come out of here."""
        item = self.context.inbox.get(self._pause_s() if timeout_s is None else timeout_s)
        if isinstance(item, Query):
            self._answer(item)
        elif item is not None and self._desk.opened:
            self.service.handle(item)
        if not self._desk.opened and self._warmed.is_set():
            self._open()
        self._namesake.require_none()
        now_ns = self.context.clock.mono_ns()
        if now_ns >= self._next_tick_ns:
            self._tick(now_ns)
        elif now_ns >= self._due_ns():
            self.service.tick(now_ns)

    def finish(self, *, error: BaseException | None = None) -> None:
        """Let the service go, answer who still waits, say a last status. The bus stays the caller's to close."""
        if self._token is not None:
            self._token.close()
        try:
            if self._desk.opened:
                self.service.close()
        finally:
            for handle in self._handles:
                handle.close()
            for item in self.context.inbox.close():
                if isinstance(item, Query):
                    item.reply_error(*encoded_as_asked(refused(Code.WRONG_STATE, "the process ends"), item))
            if error is not None:
                self._become(State.FAILED, f"{type(error).__name__}: {error}")
            else:
                self._become(State.STOPPED, self.end_reason)

    def status(self) -> ServiceStatus:
        """Return the present status."""
        context = self.context
        report = self.service.report() if self._desk.opened else Report()
        now_ns = context.clock.mono_ns()
        return ServiceStatus(
            id=context.id,
            role=context.role.value,
            state=self._state,
            start_id=context.start_id,
            heartbeat=self._heartbeat,
            reason=self._reason,
            pid=os.getpid(),
            host=_HOST,
            version=rtkmesh.__version__,
            config_hash=context.config_hash,
            uptime_s=(now_ns - self._started_ns) / 1e9,
            mono_ns=now_ns,
            last_epoch=report.last_epoch,
            inputs=list(report.inputs),
            counters={**self._own_counters(), **report.counters},
            latencies_ms=_quantiles(report, now_ns),
            data=dict(report.data),
        )

    def _own_counters(self) -> dict[str, int]:
        dropped = {f"dropped_{lane}": count for lane, count in self.context.inbox.dropped().items()}
        return {**self.context.bus.counters, **self._desk.counters, **dropped}

    def _pause_s(self) -> float:
        due_ns = min(self._next_tick_ns, self._due_ns())
        return min(max((due_ns - self.context.clock.mono_ns()) / 1e9, 0.0), self.service.tick_s)

    def _due_ns(self) -> float:
        return self.service.due_mono_ns() if self._desk.opened else inf

    def _warm(self) -> None:
        try:
            self.service.warm()
        except BaseException as error:  # noqa: BLE001  raised again in the loop by _open
            self._warm_error = error
        self._warmed.set()
        self.context.inbox.wake()

    def _open(self) -> None:
        if self._warm_error is not None:
            raise self._warm_error
        self.service.open()
        self._desk.opened = True
        self._token = self.context.bus.live_token(self.context.role.value, self.context.id)
        self._next_tick_ns = self.context.clock.mono_ns()
        self._on_open()

    def _tick(self, now_ns: int) -> None:
        self._next_tick_ns = now_ns + round(self.service.tick_s * 1e9)
        if self._desk.opened:
            self.service.tick(now_ns)
            self._take_state()
        if now_ns >= self._next_status_ns:
            self._publish()
            self._watch_hub()

    def _status_now(self) -> ServiceStatus:
        """Return the status after what a command has just done."""
        if self._desk.opened:
            self._take_state()
        return self.status()

    def _take_state(self) -> None:
        report = self.service.report()
        self._become(report.state, report.reason)

    def _become(self, state: State, reason: str = "") -> None:
        if (state, reason) == self._published:
            return
        if state != self._state:
            level = Level.ERROR if state is State.FAILED else Level.WARNING if state in {State.DEGRADED, State.STALE} else Level.INFO
            self.context.event(level, f"state_{state.value.lower()}", f"{state.value} {reason}".rstrip())
        self._state, self._reason = state, reason
        self._publish()

    def _publish(self) -> None:
        now_ns = self.context.clock.mono_ns()
        self._next_status_ns = now_ns + HEARTBEAT_NS
        self._heartbeat += 1
        self._published = (self._state, self._reason)
        status = self.status()
        self.context.bus.publish(STATUS, status)
        if self.context.bus.matched(METRICS):
            utc_ns = self.context.clock.utc_ns()
            self.context.bus.publish(METRICS, Metrics(id=status.id, role=status.role, utc_ns=utc_ns, values=metric_values(status)))

    def _watch_hub(self) -> None:
        connected = self.context.bus.connected()
        if connected != self._connected:
            self._connected = connected
            if connected:
                self.context.event(Level.INFO, "hub_back", "the hub is reached again")
            else:
                self.context.log.warning("the hub is not reached; trying again by itself")

    def _answer(self, query: Query) -> None:
        if query.key == LATEST.key(self.context.id):
            self._answer_latest(query)
        else:
            self._desk.answer(query)

    def _answer_latest(self, query: Query) -> None:
        """Answer ``?what=sol,status`` with one map of the newest messages; without ``what``: all that there are."""
        asked = [part.removeprefix("what=") for part in query.parameters.replace("&", ";").split(";") if part.startswith("what=")]
        names = asked[0].split(",") if asked else [stream.name for stream in STREAMS if _is_pullable(stream)]
        unknown = [name for name in names if name not in BY_NAME or not _is_pullable(BY_NAME[name])]
        if unknown:
            reply = refused(Code.NOT_FOUND, f"no stream {unknown[0][:64]!r}", request_id="")
            query.reply_error(*encoded_as_asked(reply, query))
            return
        newest = {name: self.context.bus.newest(BY_NAME[name]) for name in names}
        raw = {name: msgspec.Raw(found[0]) for name, found in newest.items() if found is not None}
        if wants_msgpack(query):
            query.reply(msgspec.msgpack.encode(raw), MSGPACK)
        else:
            query.reply(encode_json({name: msgspec.msgpack.decode(bytes(value)) for name, value in raw.items()}), JSON)


def _is_pullable(stream: Stream) -> bool:
    """Return whether the stream is one key of one struct."""
    return bool(stream.type) and stream.kind in {Kind.PUBLISH, Kind.CACHED} and stream.template.count("{") == 1


def _quantiles(report: Report, now_ns: int) -> dict[str, Quantiles]:
    found = {name: value.quantiles(now_ns) if isinstance(value, RollingQuantiles) else value for name, value in report.latencies.items()}
    return {name: quantiles for name, quantiles in found.items() if quantiles is not None}
