"""Feeding a caster's mount point (NTRIP server), in a thread of its own: a caster that is slow or away never holds up anybody."""

import threading
import time
from typing import Final

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ntrip.connection import CasterConnection, open_push
from rtkmesh_services.ntrip.frames import FrameQueue, StreamPicture
from rtkmesh_services.ntrip.protocol import chunk
from rtkmesh_services.output.targets import TargetUrl
from rtkmesh_services.runtime.backoff import CASTER, Backoff, Pauses

SEND_S: Final = 10.0
POLL_S: Final = 0.25


class Push:
    """Sends frames to one mount point. What the station says of itself goes first on every connection."""

    def __init__(self, url: TargetUrl, backoff: Backoff = CASTER) -> None:
        assert url.caster is not None, "frames are pushed to a caster"
        self._url, self._address = url, url.caster
        self._pauses = Pauses(backoff)
        self._queue, self._picture = FrameQueue(), StreamPicture()
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self.state, self.detail = "connecting", str(url)
        self.sent = self.errors = 0
        threading.Thread(target=self._run, daemon=True, name="push").start()

    @property
    def dropped(self) -> int:
        """Frames that were never sent."""
        return self._queue.dropped

    def send(self, frame: bytes) -> None:
        """Take a frame; never blocks."""
        now_s = time.monotonic()
        with self._changed:
            self._picture.add(frame, now_s)
            self._queue.put(frame, now_s)
            self._changed.notify()

    def close(self) -> None:
        """End the thread; returns at once."""
        self._stopping.set()
        with self._changed:
            self._changed.notify()

    def _run(self) -> None:
        while not self._stopping.is_set():
            begun_s, error = time.monotonic(), None
            try:
                self._serve()
            except (SourceError, OSError) as problem:
                error = problem
            served_s = time.monotonic() - begun_s if self.state == "connected" else 0.0
            pause_s = self._pauses.after(served_s, error)
            if error is not None:
                self._failed(error, pause_s)
            self._stopping.wait(pause_s)

    def _serve(self) -> None:
        connection = open_push(self._address, version=self._url.version, tls=self._url.tls)
        try:
            connection.set_timeout(SEND_S)
            self.state, self.detail = "connected", str(self._url)
            with self._changed:
                station = list(self._picture.station_frames())
            for frame in station:
                self._write(connection, frame)
            while not self._stopping.is_set():
                self._pass_on(connection)
        finally:
            connection.close()

    def _pass_on(self, connection: CasterConnection) -> None:
        """Send the next frame; without one, look whether the caster is still there."""
        with self._changed:
            frame = self._queue.get()
            if frame is None:
                self._changed.wait(POLL_S)
                frame = self._queue.get()
        if frame is not None:
            self._write(connection, frame)
        if connection.has_news() and connection.read() == b"":
            raise SourceError(f"{self._url}: closed by the caster")

    def _write(self, connection: CasterConnection, frame: bytes) -> None:
        connection.write(chunk(frame) if self._url.version == 2 else frame)
        self.sent += 1

    def _failed(self, error: SourceError | OSError, pause_s: float) -> None:
        text = str(error) if isinstance(error, SourceError) else f"{self._url}: {error.strerror or error}"
        again = f"; trying again in {pause_s:.0f} s" if pause_s >= 1.0 else ""
        self.state, self.detail, self.errors = "error", f"{text}{again}", self.errors + 1
