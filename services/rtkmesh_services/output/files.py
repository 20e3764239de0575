"""Texts and frames to files: new ones, never an old one; swapped at whole hours; a thread writes them, as it does for the recorder."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from rtkmesh_schemas.status import InputStatus
from rtkmesh_services.output.sender import Preface
from rtkmesh_services.output.targets import TargetUrl
from rtkmesh_services.runtime.clock import Clock
from rtkmesh_services.runtime.log_writer import LogWriter
from rtkmesh_services.runtime.path_keywords import expanded, swap_number
from rtkmesh_services.runtime.raw_log import ATTACHMENT, RawLog

AGAIN_NS: Final = 1_000_000_000  # after which a file that could not be made is tried again
CLOSE_S: Final = 0.9
Say = Callable[[str], None]


class FileSink:
    """A file, and around the instant of swapping two: the next one from ``margin_s`` before it, the last one until ``margin_s`` after it.

    ``say`` is told each new file. What a full disk refuses waits; beyond what may wait, new texts are lost, whole ones.
    """

    def __init__(self, url: TargetUrl, preface: Preface, clock: Clock, say: Say = lambda _: None) -> None:
        self._url, self._preface, self._clock, self._say = url, preface, clock, say
        self._margin_ns = round(url.margin_s * 1e9)
        self._writer = LogWriter()
        self._writer.start()
        self._log: RawLog | None = None
        self._last: RawLog | None = None  # that is still written beside it
        self._no_file, self._again_ns = "", 0
        self._sent = self.dropped = 0

    @property
    def error(self) -> str:
        """Why nothing is written, or nothing."""
        fault = self._no_file or self._writer.fault
        return f"{self._log.path if self._log is not None and not self._no_file else self._url}: {fault}" if fault else ""

    def send(self, data: bytes) -> None:
        """Take a text or frame."""
        utc_ns, mono_ns = self._clock.utc_ns(), self._clock.mono_ns()
        self._preface.add(data, mono_ns * 1e-9)
        log = self._current(utc_ns)
        self._end_last(utc_ns)
        attachment = ATTACHMENT.pack(self._sent, utc_ns, mono_ns)
        if self._last is not None:
            self._last.append(data, attachment)
        if log is None or not log.append(data, attachment):
            self.dropped += 1
        else:
            self._sent += 1

    def tick(self) -> None:
        """Open the first file, close the last one, go on in a new one where one may not grow."""
        utc_ns = self._clock.utc_ns()
        log = self._current(utc_ns)
        self._end_last(utc_ns)
        if log is not None and log in self._writer.full:
            self._create(utc_ns, log.number, log)

    def statuses(self) -> list[InputStatus]:
        """Return the file."""
        path, size = (str(self._url), 0) if self._log is None else (str(self._log.path), self._log.size)
        state = "error" if self.error else "open"
        return [InputStatus(name="file", state=state, detail=path, messages=self._sent, bytes=size, dropped=self.dropped)]

    def close(self) -> str:
        """Write everything out; return what could not be done, in words."""
        if not self._writer.close(CLOSE_S):
            return "the disk is slow: a power cut now would cost the end of the file"
        return f"the end was not written: {self._writer.fault}" if self._writer.lost else ""

    def _number(self, utc_ns: int) -> int:
        return swap_number(utc_ns, self._url.swap_hours)

    def _current(self, utc_ns: int) -> RawLog | None:
        """Return the newest file, a new one when it is time for it; None when none can be made."""
        number = self._number(utc_ns + self._margin_ns)
        if self._log is not None and self._log.number == number:
            return self._log
        if self._log is None or not self._margin_ns:
            return self._create(utc_ns, number, self._log)
        last, made = self._log, self._create(utc_ns, number, None)
        if made is not None:
            self._last = last
        return made or last

    def _end_last(self, utc_ns: int) -> None:
        if self._last is not None and self._number(utc_ns - self._margin_ns) != self._last.number:
            self._writer.end(self._last)
            self._last = None

    def _create(self, utc_ns: int, number: int, instead_of: RawLog | None) -> RawLog | None:
        now_ns = self._clock.mono_ns()
        if self._no_file and now_ns < self._again_ns:
            return None
        path = Path(expanded(self._url.path, utc_ns + self._margin_ns))
        try:
            log = RawLog.beside(path, number, tags=self._url.tags, times=False)
        except OSError as error:
            self._no_file, self._again_ns = error.strerror or str(error), now_ns + AGAIN_NS
            return None
        self._no_file, self._log = "", log
        for first in self._preface.station_frames():
            log.append(first, None)
        self._writer.take(log, instead_of)
        self._say(str(log.path))
        return log
