"""What processes write: lines of their pipes or of their log files."""

import contextlib
import json
import logging
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.runtime.log_files import append, tail
from rtkmesh_services.runtime.logs import JsonFormatter

_KEPT_LINES: Final = 200
_LAST_LINES: Final = 50  # in which the cause of a death is looked for
_CONTROL_LOGGER: Final = "rtkmesh.control"


@dataclass(frozen=True, slots=True)
class OutputLine:
    """One line that a child wrote. ``level`` and ``text`` are the record's if it was one of our JSON log lines."""

    id: str
    text: str
    level: str
    error_stream: bool
    structured: bool
    time: str = ""  # as the record says it


class OutputLog:
    """The newest lines of every process, for ``rtk/control/cmd`` ``log``."""

    def __init__(self) -> None:
        self._lines: dict[str, deque[str]] = {}

    def add(self, line: OutputLine) -> None:
        """Keep a line."""
        self._lines.setdefault(line.id, deque(maxlen=_KEPT_LINES)).append(in_words(line))

    def last(self, id: str, count: int) -> list[str]:  # noqa: A002  the word of the design
        """Return the newest lines of a process, oldest first."""
        lines = list(self._lines.get(id, ()))
        return lines[-count:] if count > 0 else []


class ProcessLog:
    """The log file of a process that outlives control; of any other, nothing. Control writes into it when it starts the process."""

    def __init__(self, spec: ProcessSpec) -> None:
        self._spec, self._file = spec, spec.log_file

    def begins(self) -> None:
        """Mark where a process begins: what stands before is not of it."""
        self._write(logging.INFO, "started by control")

    def ends(self, how: str) -> None:
        """Say how it ended, which it may not have been able to."""
        self._write(logging.WARNING, f"ended: {how}")

    def last_error(self) -> str:
        """Return the newest line of the last process that says what went wrong, at most 300 characters."""
        found = ""
        for line in self._lines(_LAST_LINES):
            if line.structured and line.text == "started by control":
                found = ""
            elif line.text and (line.level in ("error", "critical") or not line.structured):
                found = line.text[:300]
        return found

    def last(self, count: int) -> list[str]:
        """Return the newest lines, oldest first."""
        return [in_words(line) for line in self._lines(count) if line.text]

    def _lines(self, count: int) -> list[OutputLine]:
        rows = [] if self._file is None else tail(self._file, count)
        return [parse_line(self._spec.id, row, error_stream=True) for row in rows]

    def _write(self, level: int, text: str) -> None:
        if self._file is not None:
            record = logging.LogRecord(_CONTROL_LOGGER, level, "", 0, text, None, None)
            append(self._file, JsonFormatter(self._spec.id, self._spec.role.value).format(record).encode())


def in_words(line: OutputLine) -> str:
    """Return a line with its level, if it has one."""
    return f"{line.level}: {line.text}" if line.level else line.text


def parse_line(id: str, raw: bytes, *, error_stream: bool) -> OutputLine:  # noqa: A002
    """Return a line without control characters; our own JSON log lines give their level and text."""
    text = raw.decode("utf-8", "replace").strip()
    if text.startswith("{"):
        with contextlib.suppress(ValueError, TypeError, AttributeError):
            record: dict[str, Any] = json.loads(text)
            message = record.get("text", record.get("message"))
            if message is not None:
                return OutputLine(
                    id, printable(str(message)), str(record.get("level", "")).lower(), error_stream, True, str(record.get("time", ""))
                )
    return OutputLine(id, printable(text), "", error_stream, structured=False)


def printable(text: str) -> str:
    """Return text without control characters: a terminal must not obey what a receiver or caster sent."""
    return "".join(c if c.isprintable() or c == "\t" else "?" for c in text)
