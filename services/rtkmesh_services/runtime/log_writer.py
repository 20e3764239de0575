"""The thread that takes logs to the disk: it may wait for a slow disk, the work loop never does.

What has come is written four times a second and handed to the disk itself (fsync) twice a second. So a killed process loses at most a
quarter of a second, and a power cut at most half a second and what the last fsync took.
"""

import errno
import threading
import time
from collections.abc import Callable
from typing import Final

from rtkmesh_services.runtime.raw_log import RawLog

WRITE_S: Final = 0.25
SYNC_S: Final = 0.5


class LogWriter:
    """Writes logs out. ``fault``: why the disk takes nothing, empty when it does. ``full``: logs that may not grow any more."""

    def __init__(self) -> None:
        self.fault = ""
        self.full: set[RawLog] = set()
        self.lost = 0  # frames that waited in logs that were closed
        self._logs: set[RawLog] = set()
        self._replaced: list[tuple[RawLog, RawLog]] = []  # logs that are at their end, with those that go on
        self._ended: list[RawLog] = []  # that nothing goes on from
        self._finished: list[RawLog] = []  # that have still to be brought to the disk
        self._leaving: list[RawLog] = []  # that are replaced or ended, and not yet written out
        self._lock = threading.Lock()
        self._writing = threading.Lock()  # not held while the disk is waited for (fsync)
        self._synced_s = 0.0
        self._refused = self._not_synced = ""
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="log-writer", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def take(self, log: RawLog, instead_of: RawLog | None = None) -> None:
        """Take over a log, and close the one before it, whose last frames go into this one if they cannot go there."""
        with self._lock:
            self._logs.add(log)
            if instead_of is not None:
                self._logs.discard(instead_of)
                self.full.discard(instead_of)
                self._replaced.append((instead_of, log))
                self._leaving.append(instead_of)

    def end(self, log: RawLog) -> None:
        """Close a log that has no successor."""
        with self._lock:
            self._logs.discard(log)
            self.full.discard(log)
            self._ended.append(log)
            self._leaving.append(log)

    @property
    def leaving_bytes(self) -> int:
        """Bytes that wait in logs that are replaced or ended."""
        with self._lock:
            return sum(log.pending for log in self._leaving)

    def close(self, wait_s: float) -> bool:
        """Write everything out, close all logs and end; False when the disk did not take all of it within the time.

        While the thread waits for a slow disk the caller writes: then it is the system's, and only a power cut can cost it.
        """
        deadline_s = time.monotonic() + wait_s
        self._end.set()
        self._thread.join(wait_s / 2.0)
        if self._thread.is_alive() and self._writing.acquire(timeout=wait_s / 2.0):
            self._write_last()
            self._writing.release()
        self._thread.join(max(0.0, deadline_s - time.monotonic()))
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._end.wait(WRITE_S):
            with self._writing:
                self._write()
            if time.monotonic() - self._synced_s >= SYNC_S - WRITE_S / 2.0:
                self._sync()
        with self._writing:
            self._write_last()
        self._sync()

    def _write_last(self) -> None:
        self._write()
        with self._lock:
            logs, self._logs = self._logs, set()
        self.lost += sum(len(log.finish()) for log in logs)
        self._finished += logs

    def _write(self) -> None:
        with self._lock:
            logs, replaced, self._replaced = list(self._logs), self._replaced, []
            ended, self._ended = self._ended, []
        for log, successor in replaced:
            successor.give_back(log.finish())
            self._finished.append(log)
        self.lost += sum(len(log.finish()) for log in ended)
        self._finished += ended
        with self._lock:
            self._leaving = [log for log in self._leaving if log not in {*ended, *(log for log, _ in replaced)}]
        self._refused = next((fault for log in logs if (fault := self._written(log))), "")
        self.fault = self._refused or self._not_synced

    def _sync(self) -> None:
        """Bring all to the disk; last of all, because it may take long."""
        self._synced_s = time.monotonic()
        with self._lock:
            logs = list(self._logs)
        self._not_synced = next((fault for log in logs if (fault := _fault_of(log.sync))), "")
        self.fault = self._refused or self._not_synced
        while self._finished:
            self._finished.pop().close()

    def _written(self, log: RawLog) -> str:
        try:
            log.write_out()
        except OSError as error:
            if error.errno == errno.EFBIG:  # goes on in another file
                self.full.add(log)
                return ""
            return error.strerror or str(error)
        return ""


def _fault_of(step: Callable[[], None]) -> str:
    try:
        step()
    except OSError as error:
        return error.strerror or str(error)
    return ""
