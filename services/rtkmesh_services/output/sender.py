"""Threads that bring frames and texts to a taker who may be slow, stuck or away: the work loop only puts them into a bounded queue."""

import threading
import time
from collections.abc import Iterable
from typing import Final, Protocol

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ntrip.frames import FrameQueue
from rtkmesh_services.output.outlets import Opener, Outlet
from rtkmesh_services.runtime.backoff import Pauses

POLL_S: Final = 0.25
CLOSE_S: Final = 0.5  # what still waits at the end has so long to leave
MAXIMUM_BYTES: Final = 1 << 18  # that wait for one taker


class Preface(Protocol):
    """What goes first over every connection."""

    def add(self, frame: bytes, now_s: float) -> None:
        """Take note of what is sent."""
        ...

    def station_frames(self) -> Iterable[bytes]:
        """Return what goes first."""
        ...


class Header:
    """A text that goes first."""

    def __init__(self, text: bytes) -> None:
        self._text = text

    def add(self, frame: bytes, now_s: float) -> None:
        """It does not depend on what is sent."""

    def station_frames(self) -> Iterable[bytes]:
        """Return the text, if there is any."""
        return [self._text] if self._text else []


class Pump:
    """A bounded queue and what empties it into an open way out. ``put`` is called by the work loop and never blocks."""

    def __init__(self, preface: Preface, maximum_age_s: float) -> None:
        self._queue, self._preface = FrameQueue(MAXIMUM_BYTES, maximum_age_s), preface
        self._changed = threading.Condition()
        self.stopping = threading.Event()
        self.sent = self.bytes = 0

    @property
    def dropped(self) -> int:
        """What was never sent."""
        return self._queue.dropped

    @property
    def waiting(self) -> int:
        """Bytes that wait."""
        return self._queue.bytes

    def put(self, data: bytes) -> None:
        """Take a frame or text."""
        now_s = time.monotonic()
        with self._changed:
            self._preface.add(data, now_s)
            self._queue.put(data, now_s)
            self._changed.notify()

    def stop(self) -> None:
        """Let ``run`` end when the queue is empty."""
        self.stopping.set()
        with self._changed:
            self._changed.notify()

    def run(self, outlet: Outlet, *, preface: bool = True) -> None:
        """Write what is in the queue until we stop; SourceError or OSError when the taker takes no more."""
        with self._changed:
            first = list(self._preface.station_frames()) if preface else []
        for data in first:
            self._write(outlet, data)
        while (data := self._next()) or not self.stopping.is_set():
            if data:
                self._write(outlet, data)
            outlet.check()

    def _next(self) -> bytes:
        """Return the oldest, waiting for it a little; nothing when there is none."""
        with self._changed:
            data = self._queue.get()
            if data is None and not self.stopping.is_set():
                self._changed.wait(POLL_S)
                data = self._queue.get()
        return data or b""

    def _write(self, outlet: Outlet, data: bytes) -> None:
        outlet.write(data)
        self.sent, self.bytes = self.sent + 1, self.bytes + len(data)


class Sender:
    """Opens a target, again and again if need be, and sends what it is given, oldest first. ``error``: why the target takes nothing."""

    def __init__(self, opener: Opener, preface: Preface, maximum_age_s: float = 15.0) -> None:
        self._opener = opener
        self.pump = Pump(preface, maximum_age_s)
        self.state, self.detail, self.errors = "connecting", opener.name, 0
        self._outlet: Outlet | None = None
        self._thread = threading.Thread(target=self._run, daemon=True, name="sender")
        self._thread.start()

    @property
    def error(self) -> str:
        """What is wrong, or nothing."""
        return self.detail if self.state == "error" else ""

    def send(self, data: bytes) -> None:
        """Take a frame or text; never blocks."""
        self.pump.put(data)

    def close(self, wait_s: float = CLOSE_S) -> None:
        """End the thread; what waits has a little time to leave."""
        self.pump.stop()
        self._thread.join(wait_s)
        if self._thread.is_alive() and (outlet := self._outlet) is not None:
            outlet.close()

    def _run(self) -> None:
        pauses = Pauses(self._opener.backoff)
        while not self.pump.stopping.is_set():
            begun_s, error = time.monotonic(), None
            try:
                self._serve()
            except (SourceError, OSError) as problem:
                error = problem
            pause_s = pauses.after(time.monotonic() - begun_s if self.state == "connected" else 0.0, error)
            if error is not None:
                self._failed(error, pause_s)
            self.pump.stopping.wait(pause_s)

    def _serve(self) -> None:
        outlet = self._outlet = self._opener.open()
        try:
            self.state, self.detail = "connected", outlet.detail
            self.pump.run(outlet, preface=self._opener.has_preface)
        finally:
            outlet.close()

    def _failed(self, error: SourceError | OSError, pause_s: float) -> None:
        text = str(error) if isinstance(error, SourceError) else f"{self._opener.name}: {error.strerror or error}"
        again = f"; trying again in {pause_s:.0f} s" if pause_s >= 1.0 else ""
        self.state, self.detail, self.errors = "error", f"{text}{again}", self.errors + 1
