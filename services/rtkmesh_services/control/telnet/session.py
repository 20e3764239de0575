"""One client of the telnet console: login, words, cycles, farewell. Runs in a thread of its own; nothing here waits for ever."""

import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from rtkmesh_schemas.command import Reply
from rtkmesh_services.control.telnet.editor import GREETING, Kind, LineEditor, Said
from rtkmesh_services.control.telnet.screens import BANNER, CLEAR, HEADED, PASSWORD, PROMPT, help_page, shown, wire
from rtkmesh_services.control.telnet.throttle import TRIES, is_password
from rtkmesh_services.runtime.console_words import RTKRCV_WORDS, Typed, WordError, typed_line

LOGIN_S: Final = 60.0
SEND_S: Final = 10.0  # a client that does not read for so long is left
READ_BYTES: Final = 4096
MAXIMUM_WAITING: Final = 64  # lines that were typed ahead
_POLL_S: Final = 0.5


class GoneError(Exception):
    """The client has gone, or has to go; the text says why."""


@dataclass(frozen=True, kw_only=True)
class Desk:
    """What a session needs of the console that it belongs to."""

    version: str
    password: str
    idle_s: float
    allow_shutdown: bool
    ask: Callable[[str, dict[str, object]], Reply]
    shut_down: Callable[[], Reply]
    wrong: Callable[[], float]  # a wrong password: how long its answer is held back
    right: Callable[[], None]
    stopping: threading.Event


class Session:
    """Serves one client until it goes; ``run`` returns why it ended."""

    def __init__(self, connection: socket.socket, desk: Desk) -> None:
        self._socket, self._desk = connection, desk
        self._editor = LineEditor()
        self._waiting: deque[Said] = deque()
        self._poll = select.poll()
        self._poll.register(connection, select.POLLIN)

    def run(self) -> str:
        """Log the client in and do what it says."""
        self._socket.settimeout(SEND_S)
        try:
            self._send(GREETING + BANNER % self._desk.version.encode())
            self._log_in()
            self._send(PROMPT)
            while True:
                self._obey(self._next(self._desk.idle_s))
        except GoneError as error:
            return str(error)
        except OSError as error:
            return f"the connection broke: {error.strerror or error}"

    def _log_in(self) -> None:
        """Ask for the password until it is right: not often, not quickly, not for long."""
        if not self._desk.password:
            return
        deadline_s = time.monotonic() + LOGIN_S
        self._editor.masked = True
        for _ in range(TRIES):
            self._send(PASSWORD)
            said = self._next(max(deadline_s - time.monotonic(), 0.001))
            if said.kind is Kind.LOGOUT:
                raise GoneError("logged out before it had logged in")
            if said.kind is Kind.LINE and is_password(said.text, self._desk.password):
                self._editor.masked = False
                self._desk.right()
                return
            if self._desk.stopping.wait(self._desk.wrong()):
                raise GoneError("the console ends")
            self._send(b"\r\ninvalid password\r\n")
        raise GoneError("too many wrong passwords")

    def _obey(self, said: Said) -> None:
        """Do what has been said, and prompt for more."""
        if said.kind is Kind.LOGOUT:
            raise GoneError("logged out")
        if said.kind is Kind.TOO_LONG:
            self._send(b"line too long.\r\n")
        elif said.kind is Kind.BREAK:
            self._send(b"\r\n")
        elif words := said.text.split():
            self._do(words)
        self._send(PROMPT)

    def _do(self, words: list[str]) -> None:
        if words[0].startswith("!"):
            self._send(b"shell commands are not allowed.\r\n")
            return
        try:
            typed = typed_line(words, RTKRCV_WORDS)
        except WordError as error:
            self._send(wire(str(error)))
            return
        if typed.op == "exit":
            raise GoneError("logged out")
        if typed.op == "help":
            self._send(wire(help_page(self._desk.version)))
        elif typed.op == "shutdown":
            self._shut_down()
        elif typed.op == "set" and "value" not in typed.args:
            self._send(b"specify option value\r\n" if typed.args else b"specify option type\r\n")
        elif typed.cycle_s:
            self._cycle(typed)
        else:
            self._send(shown(typed.op, self._desk.ask(typed.op, typed.args)))

    def _shut_down(self) -> None:
        if not self._desk.allow_shutdown:
            self._send(b"shutdown is not allowed here: [telnet] allow_shutdown\r\n")
            return
        reply = self._desk.shut_down()
        self._send(b"rtk server shutdown\r\n" if reply.ok else wire(reply.message))

    def _cycle(self, typed: Typed) -> None:
        """Show a screen again and again, until anything is typed. What was typed is the next line's, a lone key is not."""
        due_s, last, typed_in = time.monotonic(), b"", False
        while not typed_in:
            text = shown(typed.op, self._desk.ask(typed.op, typed.args))
            if typed.op in HEADED:
                self._send(CLEAR + text)
            elif text != last:  # a solution that has been shown is not shown again
                self._send(text)
            last, due_s = text, max(due_s + typed.cycle_s, time.monotonic())
            typed_in = self._typed_before(due_s)
        if typed.op in HEADED:
            self._send(b"\r\n")

    def _typed_before(self, due_s: float) -> bool:
        """Return whether anything is typed until then; looks at least once."""
        while not self._waiting:
            left_s = due_s - time.monotonic()
            if self._readable(min(max(left_s, 0.0), _POLL_S)):
                if self._take_key(self._received()):
                    return True
            elif left_s <= 0.0:
                return False
            elif self._desk.stopping.is_set():
                raise GoneError("the console ends")
        return True

    def _take_key(self, data: bytes) -> bool:
        """Take what was typed during a cycle; return whether it ends it."""
        echo, said = self._editor.feed(data)
        if not said and not self._editor.typed:  # telnet's own words
            self._send(echo)
            return False
        if said and said[0].kind is Kind.BREAK:
            self._send(b"^C\r\n")
            self._queue(said[1:])
        elif len(data.strip()) <= 1 and all(one.kind is Kind.LINE for one in said):
            self._editor.clear()
        else:
            self._send(echo)
            self._queue(said)
        return True

    def _next(self, patience_s: float) -> Said:
        """Return the next thing that the client says; GoneError when it goes, says nothing for too long, or the console ends."""
        deadline_s = time.monotonic() + patience_s
        while not self._waiting:
            if self._desk.stopping.is_set():
                raise GoneError("the console ends")
            if patience_s and time.monotonic() > deadline_s:
                self._send(b"\r\nidle for too long: logged out\r\n")
                raise GoneError("said nothing for too long")
            if self._readable(_POLL_S):
                echo, said = self._editor.feed(self._received())
                self._send(echo)
                self._queue(said)
        return self._waiting.popleft()

    def _queue(self, said: list[Said]) -> None:
        self._waiting += said
        if len(self._waiting) > MAXIMUM_WAITING:
            raise GoneError("said more than it waited to be answered")

    def _readable(self, wait_s: float) -> bool:
        return bool(self._poll.poll(wait_s * 1e3))

    def _received(self) -> bytes:
        if self._desk.stopping.is_set():
            raise GoneError("the console ends")
        data = self._socket.recv(READ_BYTES)
        if not data:
            raise GoneError("left")
        return data

    def _send(self, data: bytes) -> None:
        if data:
            self._socket.sendall(data)
