"""The recorder role: raw logs of receivers, append-only, one new file per receiver, protocol and start; never overwritten.

A log holds the frames as they came. Beside it, ``.times`` holds one line per frame: sequence, UTC ns, monotonic ns, bytes.
"""

import struct
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BufferedWriter
from pathlib import Path
from typing import Any, ClassVar

from rtkmesh_schemas.config import RecorderTable
from rtkmesh_schemas.keys import RAW, Role
from rtkmesh_schemas.status import InputStatus, Level, State
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.path_keywords import expanded, swap_number
from rtkmesh_services.runtime.service import Context, Report, Service
from rtkmesh_services.runtime.time_tags import TagWriter

FLUSH_NS = 500_000_000  # at most this much is lost on a power cut
_ATTACHMENT = struct.Struct("<QqQ")


@dataclass(slots=True)
class RawLog:
    """One open log with its times."""

    path: Path
    data: BufferedWriter
    times: BufferedWriter
    tag: BufferedWriter | None = None
    number: int = 0
    size: int = 0
    frames: int = 0
    _tags: TagWriter | None = None

    @staticmethod
    def create(folder: Path, name: str, protocol: str, started: datetime, *, tags: bool = False) -> "RawLog":
        """Open a log under a name that does not exist yet."""
        folder.mkdir(parents=True, exist_ok=True)
        stem = f"{name}-{started:%Y%m%dT%H%M%SZ}"
        for number in range(1000):
            path = folder / f"{stem}{f'-{number}' if number else ''}.{protocol}"
            with suppress(FileExistsError):
                data = path.open("xb")
                times, tag = (path.with_name(path.name + ending) for ending in (".times", ".tag"))
                return RawLog(path, data, times.open("xb"), tag.open("xb") if tags else None)
        raise OSError(f"{folder}: no free name for {stem}.{protocol}")

    def write(self, payload: bytes, attachment: bytes | None) -> None:
        """Append one frame."""
        self.data.write(payload)
        if attachment is not None and len(attachment) == _ATTACHMENT.size:
            sequence, utc_ns, mono_ns = _ATTACHMENT.unpack(attachment)
            self.times.write(b"%d %d %d %d\n" % (sequence, utc_ns, mono_ns, len(payload)))
            self._tag(utc_ns, mono_ns, self.size + len(payload))
        self.size += len(payload)
        self.frames += 1

    def flush(self) -> None:
        """Hand everything to the operating system."""
        for file in self._files():
            file.flush()

    def close(self) -> None:
        """Close both files; what a full disk refuses is gone, the rest stays."""
        for file in self._files():
            with suppress(OSError):
                file.close()

    def _tag(self, utc_ns: int, mono_ns: int, size: int) -> None:
        if self.tag is None:
            return
        if self._tags is None:
            self._tags = TagWriter(utc_ns, mono_ns)
            self.tag.write(self._tags.header)
        self.tag.write(self._tags.record(mono_ns, size))

    def _files(self) -> list[BufferedWriter]:
        return [self.data, self.times, *([self.tag] if self.tag is not None else [])]


class RecorderService(Service):
    """Writes raw frames to files."""

    role: ClassVar[Role] = Role.RECORDER

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: RecorderTable = context.deployment.recorder[context.id]
        self._logs: dict[tuple[str, str], RawLog] = {}
        self._lost: Counter[str] = Counter()
        self._error = ""
        self._flushed_ns = 0

    def open(self) -> None:
        """Subscribe to the receivers' frames."""
        for name in self._table.receivers or tuple(self.context.deployment.ingest):
            self.context.subscribe(RAW.key(name, protocol="*"), lane="raw")

    def handle(self, item: Any) -> None:
        """Write one frame."""
        if not isinstance(item, Sample):
            return
        _, name, _, protocol = item.key.split("/")
        try:
            log = self._current(name, protocol)
            log.write(item.payload, item.attachment)
            self._recovered()
        except OSError as error:
            self._failed(name, error)

    def tick(self, now_mono_ns: int) -> None:
        """Flush regularly."""
        if now_mono_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = now_mono_ns
            try:
                for log in self._logs.values():
                    log.flush()
            except OSError as error:
                self._failed("", error)

    def report(self) -> Report:
        """Tell the files and what was lost."""
        return Report(
            state=State.DEGRADED if self._error else State.RUNNING,
            reason=self._error,
            inputs=[
                InputStatus(name=f"{name}/{protocol}", state="recording", detail=str(log.path), messages=log.frames, bytes=log.size)
                for (name, protocol), log in self._logs.items()
            ],
            counters={f"lost_{name}": count for name, count in self._lost.items()},
        )

    def close(self) -> None:
        """Close all files."""
        for log in self._logs.values():
            log.close()

    def _current(self, name: str, protocol: str) -> RawLog:
        """Return the open log, a new one when it is time for it."""
        log = self._logs.get((name, protocol))
        number = swap_number(self.context.clock.utc_ns(), self._table.swap_hours)
        if log is not None and log.number == number:
            return log
        if log is not None:
            log.close()
        return self._create(name, protocol, number)

    def _create(self, name: str, protocol: str, number: int) -> RawLog:
        utc_ns = self.context.clock.utc_ns()
        folder, started = Path(expanded(self._table.folder, utc_ns)), datetime.fromtimestamp(utc_ns * 1e-9, UTC)
        log = self._logs[name, protocol] = RawLog.create(folder, name, protocol, started, tags=self._table.tags)
        log.number = number
        self.context.event(Level.INFO, "recording", f"recording {name} to {log.path}")
        return log

    def _failed(self, name: str, error: OSError) -> None:
        if name:
            self._lost[name] += 1
        if not self._error:
            self._error = f"cannot write: {error}"
            self.context.event(Level.ERROR, "recording_failed", self._error)

    def _recovered(self) -> None:
        if self._error:
            self._error = ""
            self.context.event(Level.INFO, "recording", "writing again")


def create(context: Context) -> Service:
    """Return the recorder service of a context."""
    return RecorderService(context)
