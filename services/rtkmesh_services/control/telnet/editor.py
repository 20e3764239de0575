"""What comes from a telnet client: bytes to lines, with the echo that RTKRCV gives. Pure: no socket, no clock.

As recorded from rtkrcv 2.4.3 b34: a character is echoed as itself, blank, backspace, a password's as ``*``; CR ends a line and LF
behind it is ignored (a LF alone also ends one); BS and DEL rub out; Ctrl-C is a break; Ctrl-D at any place logs out; the arrow keys
recall lines; other control characters, bytes beyond ASCII and telnet's own commands (RFC 854) are no text.
"""

from collections import deque
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

IAC, DONT, DO, WONT, WILL, SB, INTERRUPT, SE = 255, 254, 253, 252, 251, 250, 244, 240
ECHO, SUPPRESS_GO_AHEAD = 1, 3
GREETING: Final = bytes((IAC, WILL, SUPPRESS_GO_AHEAD, IAC, WILL, ECHO))
MAXIMUM_LINE: Final = 255
MAXIMUM_HISTORY: Final = 50
_BREAK, _LOGOUT, _BELL, _BACKSPACE, _LF, _CR, _ESCAPE, _DELETE = 3, 4, 7, 8, 10, 13, 27, 127
_OURS: Final = frozenset((ECHO, SUPPRESS_GO_AHEAD))
_MAXIMUM_ANSWERS: Final = 64  # to telnet's options, of one connection: nobody makes us talk for ever


class Kind(Enum):
    """What a client has said."""

    LINE = auto()
    TOO_LONG = auto()
    BREAK = auto()
    LOGOUT = auto()


@dataclass(frozen=True, slots=True)
class Said:
    """One thing that a client has said; ``text`` is that of a line."""

    kind: Kind
    text: str = ""


class LineEditor:
    """The line that a client types. ``masked``: a password, echoed as stars and not kept in the history."""

    def __init__(self) -> None:
        self.masked = False
        self._line = bytearray()
        self._too_long = False
        self._after_cr = False
        self._command = bytearray()  # of telnet, as far as it has come
        self._escape = b""
        self._answers = 0
        self._history: deque[str] = deque(maxlen=MAXIMUM_HISTORY)
        self._recalled = 0

    @property
    def typed(self) -> bool:
        """Whether an unfinished line has characters."""
        return bool(self._line)

    def clear(self) -> None:
        """Forget the unfinished line."""
        self._line.clear()
        self._too_long, self._recalled = False, 0

    def feed(self, data: bytes) -> tuple[bytes, list[Said]]:
        """Take bytes as they came; return what is to be echoed, and what has been said."""
        echo, said = bytearray(), list[Said]()
        for byte in data:
            if self._command or byte == IAC:
                self._negotiate(byte, echo, said)
            elif self._escape or byte == _ESCAPE:
                self._escaped(byte, echo)
            else:
                self._typed(byte, echo, said)
        return bytes(echo), said

    def _typed(self, byte: int, echo: bytearray, said: list[Said]) -> None:
        after_cr, self._after_cr = self._after_cr, byte == _CR
        if byte == _CR or (byte == _LF and not after_cr):
            self._end_line(echo, said)
        elif byte == _BREAK:
            self._break(echo, said)
        elif byte == _LOGOUT:
            said.append(Said(Kind.LOGOUT))
        elif byte in (_BACKSPACE, _DELETE):
            self._rub_out(echo)
        elif 32 <= byte < _DELETE:
            self._add(byte, echo)

    def _add(self, byte: int, echo: bytearray) -> None:
        if len(self._line) >= MAXIMUM_LINE:
            self._too_long = True
            return
        self._line.append(byte)
        echo += b"* \b" if self.masked else bytes((byte, 32, _BACKSPACE))

    def _rub_out(self, echo: bytearray) -> None:
        if self._line:
            self._line.pop()
            echo += b"\b \b"

    def _end_line(self, echo: bytearray, said: list[Said]) -> None:
        text, too_long = self._line.decode("ascii"), self._too_long
        self.clear()
        echo += b"\r\n"
        said.append(Said(Kind.TOO_LONG if too_long else Kind.LINE, text))
        if text.strip() and not self.masked and not too_long:
            self._history.append(text)

    def _break(self, echo: bytearray, said: list[Said]) -> None:
        self.clear()
        echo += b"^C\r\n"
        said.append(Said(Kind.BREAK))

    def _escaped(self, byte: int, echo: bytearray) -> None:
        """Take one byte of an escape sequence: ESC [ parameters letter, ESC O letter, or ESC and one more."""
        self._escape += bytes((byte,))
        if self._escape in (b"\x1b", b"\x1b[", b"\x1bO") or (self._escape.startswith(b"\x1b[") and not 64 <= byte < _DELETE):
            if len(self._escape) < 16:
                return
        elif byte in b"AB" and len(self._escape) > 2 and not self.masked:
            self._recall(1 if byte == ord("A") else -1, echo)
        self._escape = b""

    def _recall(self, step: int, echo: bytearray) -> None:
        """Put an earlier line (or, at the end, an empty one) in the line's place."""
        place = min(max(self._recalled + step, 0), len(self._history))
        while self._line:
            self._rub_out(echo)
        for byte in self._history[-place].encode() if place else b"":
            self._add(byte, echo)
        self._recalled = place

    def _negotiate(self, byte: int, echo: bytearray, said: list[Said]) -> None:
        """Take one byte of telnet's own commands."""
        self._command.append(byte)
        if len(self._command) == 1:
            return
        word = self._command[1]
        if word in (WILL, WONT, DO, DONT):
            if len(self._command) == 3:
                self._answer(word, byte, echo)
                self._command.clear()
        elif word == SB:
            if self._command.endswith(bytes((IAC, SE))):
                self._command.clear()
            elif len(self._command) > 3:
                del self._command[2]  # what it says is of no use: only its end is looked for
        else:
            self._command.clear()
            if word == INTERRUPT:
                self._break(echo, said)

    def _answer(self, word: int, option: int, echo: bytearray) -> None:
        """Answer an offer or a wish as RTKRCV does for the two options that it knows, with a refusal for all others."""
        if word not in (WILL, DO) or self._answers >= _MAXIMUM_ANSWERS:
            return
        self._answers += 1
        agreed, refusal = (DO, DONT) if word == WILL else (WILL, WONT)
        echo += bytes((IAC, agreed if option in _OURS else refusal, option))
