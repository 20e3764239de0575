"""Waking a thread that waits in a selector."""

import socket
from contextlib import suppress


class Waker:
    """Register ``reader`` for reading; ``wake`` makes it readable from any thread, ``drain`` is for the one that was woken."""

    def __init__(self) -> None:
        self._writer, self.reader = socket.socketpair()
        self._writer.setblocking(False)
        self.reader.setblocking(False)

    def wake(self) -> None:
        """Wake the thread."""
        with suppress(OSError):  # full: it is awake anyway; closed: nobody waits
            self._writer.send(b"\0")

    def drain(self) -> None:
        """Take note of having been woken."""
        with suppress(OSError):
            while self.reader.recv(4096):
                pass

    def close(self) -> None:
        """Close both ends."""
        self._writer.close()
        self.reader.close()
