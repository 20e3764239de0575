"""The output role: one output stream of a solver, as rtkrcv's outstr: text lines to a file, TCP or UDP."""

from typing import Any, ClassVar

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import SOL, SOL_TEXT, Role
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import InputStatus, Level, State
from rtkmesh_schemas.wire import decode, encode_json
from rtkmesh_services.output.frames import FrameOutputService
from rtkmesh_services.output.targets import Target, open_target
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context, Report, Service

RETRY_NS = 1_000_000_000


class OutputService(Service):
    """Writes a solver's solutions to one target."""

    role: ClassVar[Role] = Role.OUTPUT

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: OutputTable = context.deployment.output[context.id]
        self._target: Target | None = None
        self._error = ""
        self._lines = self._lost = 0
        self._tried_ns = 0

    def open(self) -> None:
        """Open the target and subscribe to the solver."""
        self._open_target()
        json = self._table.format == "json"
        key = SOL.key(self._table.solver) if json else SOL_TEXT.key(self._table.solver, format=self._table.format)
        self.context.subscribe(key, lane="sol")

    def handle(self, item: Any) -> None:
        """Write one solution."""
        if not isinstance(item, Sample):
            return
        try:
            line = self._line(item)
            if self._target is None:
                raise ConnectionError(self._error or "target is not open")
            self._target.send(item.attachment or b"", line)
            self._lines += 1
            self._error = ""
        except (DecodeError, VersionError, OSError) as error:
            self._lost += 1
            self._failed(str(error))

    def tick(self, now_mono_ns: int) -> None:
        """Let the target accept, reconnect and flush; try again to open it."""
        if self._target is not None:
            try:
                self._target.tick()
            except OSError as error:
                self._failed(str(error))
        elif now_mono_ns - self._tried_ns > RETRY_NS:
            self._tried_ns = now_mono_ns
            self._open_target()

    def report(self) -> Report:
        """Tell the target and the lines."""
        state = State.DEGRADED if self._error else State.RUNNING
        detail = "" if self._target is None else self._target.detail
        target = InputStatus(name=self._table.solver, state=state.value, detail=detail, messages=self._lines, dropped=self._lost)
        return Report(state=state, reason=self._error, inputs=[target], counters={"lines": self._lines, "lines_lost": self._lost})

    def close(self) -> None:
        """Close the target."""
        if self._target is not None:
            self._target.close()

    def _line(self, sample: Sample) -> bytes:
        if self._table.format != "json":
            return sample.payload if sample.payload.endswith(b"\n") else sample.payload + b"\n"
        return encode_json(decode(SolutionMessage, sample.payload, sample.encoding)) + b"\n"

    def _open_target(self) -> None:
        try:
            self._target = open_target(self._table.target)
            self._error = ""
        except OSError as error:
            self._failed(f"{self._table.target}: {error.strerror or error}")

    def _failed(self, error: str) -> None:
        if error != self._error:
            self._error = error
            self.context.event(Level.WARNING, "output_failed", error)


def create(context: Context) -> Service:
    """Return the output service of a context: of a solver's lines, or of receivers' frames."""
    return OutputService(context) if context.deployment.output[context.id].solver else FrameOutputService(context)
