"""What goes to a receiver: commands when it comes, again and again, and when we leave; frames; corrections as its link carries them."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from math import inf
from queue import Empty, Full, Queue
from typing import Final

import serial

from rtkmesh_services.ingest.commands import ReceiverCommands, Send, Step, Wait
from rtkmesh_services.ingest.corrections import CorrectionQueue
from rtkmesh_services.ingest.serial_ports import SerialWire
from rtkmesh_services.ingest.wires import POLL_S, Wire

WRITE_QUEUE: Final = 256
FAREWELL_S: Final = 0.5  # what the pauses between stop commands may take together


class Writer:
    """Writes to the wire that is open. ``run`` is a thread's; the reader's thread opens and closes."""

    def __init__(self, commands: ReceiverCommands, failed: Callable[[str], None], corrections: CorrectionQueue | None = None) -> None:
        self._commands, self._failed = commands, failed
        self._corrections = corrections or CorrectionQueue()
        self._free_s = 0.0  # when the link will have carried what was written
        self._queue: Queue[bytes] = Queue(WRITE_QUEUE)
        self._wire: Wire | None = None
        self._due_s = [inf] * len(commands.periodic)

    def opened(self, wire: Wire) -> None:
        """A connection is there: its receiver is told the start commands."""
        self._corrections.opened(wire.bytes_per_s, self._wake)
        self._wire = wire
        self._wake()

    def closing(self, wire: Wire, *, leaving: bool) -> None:
        """A connection is about to be closed; when we leave for good, the receiver is told the stop commands."""
        self._wire = None
        if leaving:
            self._do(wire, self._commands.stop, FAREWELL_S)

    def put(self, data: bytes) -> bool:
        """Queue bytes; False (and nothing queued) when the queue is full or nothing is connected."""
        if self._wire is None:
            return False
        try:
            self._queue.put_nowait(data)
        except Full:
            return False
        return True

    def run(self, stopping: threading.Event) -> None:
        """Write until ``stopping`` is set."""
        served: Wire | None = None
        while not stopping.is_set():
            wire = self._wire
            if wire is not None and wire is not served:
                self._do(wire, self._commands.start, inf)
                self._due_s = [time.monotonic()] * len(self._commands.periodic)
            served = wire
            data = self._next()
            if data and served is not None:
                self._write(served, data)
            elif served is not None and served is self._wire:
                self._correct(served)
            if served is not None and served is self._wire:
                self._do_periodic(served)

    def _next(self) -> bytes:
        now_s = time.monotonic()
        due_s = [*self._due_s, self._free_s if self._corrections.waiting and self._wire is not None else inf]
        pause_s = min(POLL_S, max(0.0, min(due_s) - now_s))
        try:
            return self._queue.get(timeout=pause_s) if pause_s > 0.0 else self._queue.get_nowait()
        except Empty:
            return b""

    def _correct(self, wire: Wire) -> None:
        """Write the next correction when the link has carried all before it: what waits here may still give way, what is written not."""
        now_s = time.monotonic()
        correction = self._corrections.get(now_s) if now_s >= self._free_s else None
        if correction is None:
            return
        if self._write(wire, correction.frame):
            self._corrections.written(correction, time.monotonic())
        else:
            self._corrections.lost(correction)

    def _do_periodic(self, wire: Wire) -> None:
        now_s = time.monotonic()
        for index, row in enumerate(self._commands.periodic):
            if now_s >= self._due_s[index]:
                self._due_s[index] = max(now_s, self._due_s[index] + row.period_s)
                self._do(wire, (row.step,), inf)

    def _do(self, wire: Wire, steps: tuple[Step, ...], pauses_s: float) -> None:
        for step in steps:
            if isinstance(step, Send):
                self._write(wire, step.data)
            elif isinstance(step, Wait):
                pause_s = min(step.seconds, pauses_s)
                pauses_s -= pause_s
                time.sleep(pause_s)
            elif isinstance(wire, SerialWire):
                self._attempt(wire, partial(wire.set_baud, step.rate))

    def _write(self, wire: Wire, data: bytes) -> bool:
        if self._corrections.rate > 0.0:
            self._free_s = max(self._free_s, time.monotonic()) + len(data) / self._corrections.rate
        return self._attempt(wire, partial(wire.write, data))

    def _attempt(self, wire: Wire, act: Callable[[], None]) -> bool:
        try:
            act()
        except (OSError, serial.SerialException) as error:
            if wire is self._wire:
                self._failed(f"writing: {error}")
            return False
        return True

    def _wake(self) -> None:
        with suppress(Full):  # it is awake anyway
            self._queue.put_nowait(b"")
