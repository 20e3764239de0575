"""The recorder role: raw logs of receivers, append-only, one new file per receiver, protocol and start; never overwritten.

A log holds the frames as they came. Beside it, ``.times`` holds one line per frame: sequence, UTC ns, monotonic ns, bytes. Where the disk
is full, recording stops between two frames and goes on when there is room; positioning knows nothing of it.
"""

from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Final

from rtkmesh_schemas.config import RecorderTable
from rtkmesh_schemas.keys import RAW, Role
from rtkmesh_schemas.status import InputStatus, Level, State
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.log_writer import LogWriter
from rtkmesh_services.runtime.path_keywords import expanded, swap_number
from rtkmesh_services.runtime.raw_log import RawLog
from rtkmesh_services.runtime.service import Context, Report, Service

AGAIN_NS: Final = 1_000_000_000  # after which a file that could not be made is tried again
CLOSE_S: Final = 0.9


class RecorderService(Service):
    """Gives raw frames to logs; a thread writes them."""

    role: ClassVar[Role] = Role.RECORDER

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: RecorderTable = context.deployment.recorder[context.id]
        self._logs: dict[tuple[str, str], RawLog] = {}
        self._writer = LogWriter()
        self._lost: Counter[str] = Counter()
        self._lost_before = 0  # of all receivers, when the present fault began
        self._no_file, self._again_ns = "", 0
        self._error = ""

    def open(self) -> None:
        """Subscribe to the receivers' frames."""
        self._writer.start()
        for name in self._table.receivers or tuple(self.context.deployment.ingest):
            self.context.subscribe(RAW.key(name, protocol="*"), lane="raw")

    def handle(self, item: Any) -> None:
        """Take one frame."""
        if not isinstance(item, Sample):
            return
        _, name, _, protocol = item.key.split("/")
        log = self._current(name, protocol)
        if log is None or not log.append(item.payload, item.attachment):
            self._lost[name] += 1

    def tick(self, now_mono_ns: int) -> None:  # noqa: ARG002  the hook's form
        """Go on in new files where the old ones may not grow, and tell when the disk refuses or takes again."""
        for (name, protocol), log in list(self._logs.items()):
            if log in self._writer.full:
                self._create(name, protocol, log.number)
        fault = self._no_file or self._writer.fault
        if fault and not self._error:
            self._error, self._lost_before = f"cannot write: {fault}", self._lost.total()
            self.context.event(Level.ERROR, "recording_failed", self._error, logged=False)
        elif self._error and not fault:
            self._error = ""
            lost = self._lost.total() - self._lost_before
            self.context.event(
                Level.INFO, "recording", f"writing again; {lost} frames were lost" if lost else "writing again; nothing was lost"
            )

    def report(self) -> Report:
        """Tell the files and what was lost."""
        return Report(
            state=State.DEGRADED if self._error else State.RUNNING,
            reason=self._error,
            inputs=[
                InputStatus(
                    name=f"{name}/{protocol}",
                    state="waiting for the disk" if self._error else "recording",
                    detail=str(log.path),
                    messages=log.frames,
                    bytes=log.size,
                    lost=self._lost[name],
                )
                for (name, protocol), log in self._logs.items()
            ],
            counters={f"lost_{name}": count for name, count in self._lost.items()},
            data={"waiting_bytes": sum(log.pending for log in self._logs.values()) + self._writer.leaving_bytes},
        )

    def close(self) -> None:
        """Write everything out and close all files."""
        if not self._writer.close(CLOSE_S):
            self.context.log.warning("the disk is slow: a power cut now would cost the end of the recording")
        if self._writer.lost:
            self.context.log.error("%d frames at the end were not written: %s", self._writer.lost, self._writer.fault)

    def _current(self, name: str, protocol: str) -> RawLog | None:
        """Return the open log, a new one when it is time for it; None when none can be made."""
        log = self._logs.get((name, protocol))
        number = swap_number(self.context.clock.utc_ns(), self._table.swap_hours)
        if log is not None and log.number == number:
            return log
        return self._create(name, protocol, number)

    def _create(self, name: str, protocol: str, number: int) -> RawLog | None:
        now_ns, utc_ns = self.context.clock.mono_ns(), self.context.clock.utc_ns()
        if self._no_file and now_ns < self._again_ns:
            return None
        folder, started = Path(expanded(self._table.folder, utc_ns)), datetime.fromtimestamp(utc_ns * 1e-9, UTC)
        try:
            log = RawLog.create(folder, name, protocol, started, number, tags=self._table.tags)
        except OSError as error:
            self._no_file, self._again_ns = f"{folder}: {error.strerror or error}", now_ns + AGAIN_NS
            return None
        self._no_file = ""
        self._writer.take(log, self._logs.get((name, protocol)))
        self._logs[name, protocol] = log
        self.context.event(Level.INFO, "recording", f"recording {name} to {log.path}")
        return log


def create(context: Context) -> Service:
    """Return the recorder service of a context."""
    return RecorderService(context)
