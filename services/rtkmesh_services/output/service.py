"""The output role: one output stream, as rtkrcv's outstr: a solver's solutions as text, or receivers' frames, to one target."""

from collections.abc import Iterable
from typing import Any, ClassVar, Final

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import EVENT, SAT, SOL, Role
from rtkmesh_schemas.solution import SatellitesMessage, SolutionMessage
from rtkmesh_schemas.status import Event, InputStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.output.frames import FrameOutputService
from rtkmesh_services.output.opening import open_caster, open_sink
from rtkmesh_services.output.sender import Header
from rtkmesh_services.output.targets import check_output
from rtkmesh_services.output.text_feed import TextFeed
from rtkmesh_services.output.watch import Watch, drain
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context, Report, Service

MARK: Final = "mark"  # the code of a solver's event


class OutputService(Service):
    """Writes a solver's solutions to one target."""

    role: ClassVar[Role] = Role.OUTPUT

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: OutputTable = context.deployment.output[context.id]
        check_output(self._table)
        self._feed = TextFeed(self._table, context.deployment.solver[self._table.solver])
        self._watch: Watch | None = None
        self._newest: SolutionMessage | None = None
        self._solutions = self._lost = self._lines = self._errors = 0

    def open(self) -> None:
        """Open the target and subscribe to the solver."""
        context, table = self.context, self._table
        header = self._feed.header
        sink = open_caster(context, table, source_table_format(table), header) or open_sink(context, table, Header(header))
        self._watch = Watch(context, sink)
        self._watch.tick(context.clock.mono_ns())
        context.subscribe(SOL.key(table.solver), lane="sol")
        context.subscribe(EVENT.key(table.solver, level="*"), lane="sol")
        if table.takes_satellites:
            context.subscribe(SAT.key(table.solver), lane="sol")

    def handle(self, item: Any) -> None:
        """Take a solution, its satellites or an event."""
        if not isinstance(item, Sample):
            return
        kind, now_ns = item.key.split("/")[2], self.context.clock.mono_ns()
        try:
            if kind == "sol":
                solution = decode(SolutionMessage, item.payload, item.encoding)
                self._count(solution)
                self._send(self._feed.solution(solution, now_ns))
            elif kind == "sat":
                self._send(self._feed.satellites(decode(SatellitesMessage, item.payload, item.encoding), now_ns))
            elif (event := decode(Event, item.payload, item.encoding)).code == MARK:
                self._send([self._feed.mark(event.data)])
        except (DecodeError, VersionError):
            self._errors += 1

    def tick(self, now_mono_ns: int) -> None:
        """Write what has waited long enough; look after the target."""
        self._send(self._feed.overdue(now_mono_ns))
        if self._watch is not None:
            self._watch.tick(now_mono_ns)

    def due_mono_ns(self) -> float:
        """Return when an epoch has waited long enough for its satellites."""
        return self._feed.due_ns()

    def report(self) -> Report:
        """Tell the solver, the target and its clients."""
        state = "heard" if self._solutions else "silent"
        solver = InputStatus(name=self._table.solver, state=state, messages=self._solutions, lost=self._lost)
        counters = {"lines": self._lines, "errors": self._errors}
        if self._watch is None:
            return Report(inputs=[solver], counters=counters)
        sink, newest = self._watch.sink, self._newest
        return Report(
            state=self._watch.state,
            reason=self._watch.reason,
            inputs=[solver, *sink.statuses()],
            counters={**counters, "lines_lost": sink.dropped},
            last_epoch=None if newest is None else (newest.week, newest.tow_s),
        )

    def close(self) -> None:
        """Write the rest and close the target."""
        drain(self.context, self.handle)
        self._send(self._feed.rest())
        if self._watch is not None:
            self._watch.close()

    def _send(self, texts: Iterable[bytes]) -> None:
        for text in texts:
            assert self._watch is not None, "nothing comes before it is open"
            self._watch.sink.send(text)
            self._lines += 1

    def _count(self, solution: SolutionMessage) -> None:
        """Count the solution, and those before it that did not come."""
        last, self._newest = self._newest, solution
        self._solutions += 1
        if last is not None and last.start_id == solution.start_id:
            self._lost += max(0, solution.sequence - last.sequence - 1)


def source_table_format(table: OutputTable) -> str:
    """Return what our caster's source table says of a solver's text."""
    return {"nmea": "NMEA", "json": "JSON"}.get(table.format, f"RTKLIB {table.format}")


def create(context: Context) -> Service:
    """Return the output service of a context: of a solver's lines, or of receivers' frames."""
    return OutputService(context) if context.deployment.output[context.id].solver else FrameOutputService(context)
