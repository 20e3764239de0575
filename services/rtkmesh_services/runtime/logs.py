"""Logging of a process: one line a record on stderr, readable on a terminal, JSON elsewhere, and on ``rtk/{id}/log``.

Secrets in URLs are masked and control characters stripped before anything is written: text from receivers and casters ends
up here.
"""

import json
import logging
import re
import sys
import threading
from typing import Any, Final, TextIO

from rtkmesh_schemas.keys import LOG
from rtkmesh_schemas.status import LogRecord
from rtkmesh_services.runtime.bus import Bus

MAXIMUM_TEXT: Final = 4000
# A user may be a mail address, a password may hold anything but spaces: all up to the last @ is secret.
_SECRET: Final = re.compile(r"(?P<head>[a-z][a-z0-9+.-]*://[^\s:/?#]*):(?P<secret>\S+)@", re.IGNORECASE)
_SECRET_TABLES: Final = ("users",)
_SECRET_NAMES: Final = ("password",)
_NAMED_SECRET: Final = re.compile(r"(?P<head>\b(?:password|passwd|secret|token|pw)=)[^\s&;\"']+", re.IGNORECASE)
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_COLOURS: Final = {"DEBUG": "\x1b[2m", "WARNING": "\x1b[33m", "ERROR": "\x1b[31m", "CRITICAL": "\x1b[31m"}


def clean(text: str) -> str:
    """Return text fit for a terminal, a log and a web page: secrets masked, control characters gone, length bounded."""
    if "://" in text:
        text = _SECRET.sub(r"\g<head>:***@", text)
    if "=" in text:
        text = _NAMED_SECRET.sub(r"\g<head>***", text)
    return _CONTROL.sub("�", text)[:MAXIMUM_TEXT]


def masked(value: Any) -> Any:
    """Return a plain value (dicts, lists, strings) with the secrets in its strings and in its tables of users masked."""
    if isinstance(value, str):
        return clean(value)
    if isinstance(value, dict):
        return {name: _hidden(item) if name in _SECRET_TABLES else _named(name, item) for name, item in value.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any plain value
    if isinstance(value, (list, tuple)):
        return [masked(item) for item in value]  # pyright: ignore[reportUnknownVariableType]  any plain value
    return value


def _named(name: Any, value: Any) -> Any:
    return "***" if name in _SECRET_NAMES and value else masked(value)


def _hidden(value: Any) -> Any:
    return dict.fromkeys(value, "***") if isinstance(value, dict) else masked(value)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any plain value


def fields_of(record: logging.LogRecord) -> dict[str, Any]:
    """Return the fields given with ``extra={"fields": {...}}``, secrets masked."""
    fields: dict[str, Any] = masked(getattr(record, "fields", {}))
    return fields


class JsonFormatter(logging.Formatter):
    """One JSON object a line."""

    def __init__(self, id: str, role: str) -> None:  # noqa: A002  the word of the design
        super().__init__()
        self._id, self._role = id, role

    def format(self, record: logging.LogRecord) -> str:
        """See logging."""
        row = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S") + f".{int(record.msecs):03d}",
            "level": record.levelname.lower(),
            "id": self._id,
            "role": self._role,
            "logger": record.name,
            "text": text_of(record),
            **({"fields": fields} if (fields := fields_of(record)) else {}),
        }
        return json.dumps(row, default=str, ensure_ascii=False)


class TerminalFormatter(logging.Formatter):
    """A line for people."""

    def __init__(self, id: str) -> None:  # noqa: A002
        super().__init__()
        self._id = id

    def format(self, record: logging.LogRecord) -> str:
        """See logging."""
        colour = _COLOURS.get(record.levelname, "")
        line = f"{self.formatTime(record, '%H:%M:%S')} {self._id:<12} {record.levelname.lower():<7} {text_of(record)}"
        return f"{colour}{line}\x1b[0m" if colour else line


class BusHandler(logging.Handler):
    """Publishes records of INFO and above on ``rtk/{id}/log`` while somebody listens."""

    def __init__(self, bus: Bus, role: str) -> None:
        super().__init__(logging.INFO)
        self._bus, self._role = bus, role
        self._busy = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        """See logging. What the bus itself logs while publishing is not published again."""
        if getattr(self._busy, "now", False):
            return
        self._busy.now = True
        try:
            if self._bus.matched(LOG):
                self._bus.publish(LOG, self._wire(record))
        finally:
            self._busy.now = False

    def _wire(self, record: logging.LogRecord) -> LogRecord:
        return LogRecord(
            id=self._bus.id,
            role=self._role,
            level=record.levelname.lower(),
            logger=record.name,
            text=text_of(record),
            utc_ns=int(record.created * 1e9),
            fields={name: value if isinstance(value, (str, int, float, bool)) else str(value) for name, value in fields_of(record).items()},
        )


def configure(id: str, role: str, level: str, stream: TextIO | None = None) -> logging.Logger:  # noqa: A002
    """Set up this process's logging; return the logger of the service."""
    out: TextIO = sys.stderr if stream is None else stream
    handler = logging.StreamHandler(out)
    handler.setFormatter(TerminalFormatter(id) if out.isatty() else JsonFormatter(id, role))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    for noisy in ("numba", "hatanaka"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    return logging.getLogger("rtkmesh")


def text_of(record: logging.LogRecord) -> str:
    """Return the message with its traceback, cleaned; lines kept."""
    text = record.getMessage()
    if record.exc_info:
        text += "\n" + logging.Formatter().formatException(record.exc_info)
    return clean(text)
