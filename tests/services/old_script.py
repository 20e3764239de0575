"""What scripts for RTKRCV's telnet console rely on, recorded byte by byte from rtkrcv 2.4.3 b34, and such a script."""

import socket
from contextlib import suppress

from tests.patience import PATIENCE_S

GREETING = b"\xff\xfb\x03\xff\xfb\x01\r\n\x1b[1m** rtkrcv ver."
LOGIN = b" console (h:help) **\x1b[0m\r\npassword: "
PASSWORD = b"secret"
STARS = b"* \x08"

# What is sent, and the echo of it, at the prompt.
ECHOES = [
    (b"foo\r\n", b"f \x08o \x08o \x08\r\n"),
    (b"zta\x08\x08\x08x\r\n", b"z \x08t \x08a \x08\x08 \x08\x08 \x08\x08 \x08x \x08\r\n"),
    (b"ab\x7fc\r\n", b"a \x08b \x08\x08 \x08c \x08\r\n"),
    (b"zto\r\x00", b"z \x08t \x08o \x08\r\n"),
    (b"\x01\x02\xff\xfb\x01ztop\xc3\xa9\r\n", b"\xff\xfd\x01z \x08t \x08o \x08p \x08\r\n"),
    (b"\xff\xfd\x01\xff\xfd\x03ztop\r\n", b"\xff\xfb\x01\xff\xfb\x03z \x08t \x08o \x08p \x08\r\n"),
    (b"abc\x15\r\n", b"a \x08b \x08c \x08\r\n"),
    (b"abc\x03", b"a \x08b \x08c \x08^C\r\n"),
    (b"\r\n", b"\r\n"),
]

STATUS_HEAD = b"\r\n\x1b[1mParameter                   : Value\x1b[0m\r\n"
SATELLITE_HEAD = b"\r\n\x1b[1mSAT C1    Az   El L1 L2  Fix1  Fix2  P1Res  P2Res   L1Res   L2Res  Sl1  Sl2  Lock1  Lock2 Rj1 Rj2\x1b[0m\r\n"


class OldScript:
    """A client that waits for what it expects, as `expect` does."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self._rest = b""

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def expect(self, mark: bytes) -> bytes:
        """Return everything up to the mark; it is an error if the other side hangs up or is silent."""
        while mark not in self._rest:
            data = self.socket.recv(65536)
            assert data, f"hung up before {mark!r}: {self._rest!r}"
            self._rest += data
        found, _, self._rest = self._rest.partition(mark)
        return found + mark

    def ask(self, line: bytes) -> bytes:
        """Send a line; return what comes up to the next prompt, without the prompt."""
        self.send(line)
        return self.expect(b"rtkrcv> ").removesuffix(b"rtkrcv> ")

    def log_in(self) -> bytes:
        greeting = self.expect(b"password: ")
        self.send(PASSWORD + b"\r\n")
        return greeting + self.expect(b"rtkrcv> ")

    def to_the_end(self) -> bytes:
        """Return everything until the other side hangs up."""
        with suppress(ConnectionResetError):
            while data := self.socket.recv(65536):
                self._rest += data
        self.close()
        return self._rest

    def close(self) -> None:
        self.socket.close()


def run_old_script(port: int) -> dict[str, bytes]:
    """Run the script, and hang up whatever happens."""
    script = OldScript(port)
    try:
        return _run(script)
    finally:
        script.close()


def _run(script: OldScript) -> dict[str, bytes]:
    """Log in, ask for the screens, watch solutions for a while, log out: return what was shown."""
    seen = {"login": script.log_in()}
    for word in (b"status", b"satellite"):
        seen[word.decode()] = script.ask(word + b"\r\n")
    script.send(b"status 1\r\n")
    seen["cycle"] = script.expect(b"\x1b[0m\r\n")
    script.send(b"\x03")
    seen["after cycle"] = script.expect(b"^C\r\n\r\nrtkrcv> ")
    script.send(b"solution 1\r\n")
    script.expect(b"n \x08  \x081 \x08\r\n")
    script.send(b"\x03")
    seen["solution"] = script.expect(b"^C\r\nrtkrcv> ")
    seen["unknown"] = script.ask(b"nonsense\r\n")
    script.send(b"exit\r\n")
    seen["exit"] = script.to_the_end()
    return seen


def echo_of(text: bytes) -> bytes:
    """Return how a line is echoed."""
    return b"".join(bytes((byte, 32, 8)) for byte in text) + b"\r\n"
