"""What a receiver is told when it is there, when we leave, and again and again: lists in the deployment file, or RTKLIB's command files.

A line is text for the receiver (sent with CR LF), or ``!UBX CFG-...``, ``!HEX B5 62 ...``, ``!WAIT milliseconds``, ``!BRATE baud``; a
periodic line may end in ``# milliseconds``. In a file, lines that begin with ``@`` end the sections start, stop, periodic.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Final

from rtkmesh_schemas.config import IngestTable
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.ubx_commands import ubx_frame

LONGEST_WAIT_S: Final = 3.0
DEFAULT_PERIOD_S: Final = 1.0
SHORTEST_PERIOD_S: Final = 0.05
MAXIMUM_LINES: Final = 1000
MAXIMUM_FILE: Final = 65536
LISTENING: Final = ("serial", "tcp", "tcp-listen")
_WORDS: Final = ("!UBX", "!HEX", "!WAIT", "!BRATE")
_SECTIONS: Final = 3


@dataclass(frozen=True, slots=True)
class Send:
    """Bytes for the receiver."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Wait:
    """A pause."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Baud:
    """The port goes on at another rate."""

    rate: int


Step = Send | Wait | Baud


@dataclass(frozen=True, slots=True)
class Periodic:
    """A step that is done again and again."""

    step: Step
    period_s: float


@dataclass(frozen=True, slots=True)
class ReceiverCommands:
    """All commands of one receiver."""

    start: tuple[Step, ...] = ()
    stop: tuple[Step, ...] = ()
    periodic: tuple[Periodic, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.start or self.stop or self.periodic)

    def __add__(self, other: "ReceiverCommands") -> "ReceiverCommands":
        return ReceiverCommands(self.start + other.start, self.stop + other.stop, self.periodic + other.periodic)


def commands_of(table: IngestTable, folder: Path) -> ReceiverCommands:
    """Return the commands of an ingest: of its file, then of its lists; SourceError says what is wrong with them."""
    told = table.commands
    found = parse_commands(told.start, told.stop, told.periodic)
    if told.file:
        found = _read_file(folder / told.file) + found
    if found and table.source.partition("://")[0] not in LISTENING:
        raise SourceError(f"commands go to a receiver: the source must be one of {', '.join(LISTENING)}")
    return found


def _read_file(path: Path) -> ReceiverCommands:
    try:
        if path.stat().st_size > MAXIMUM_FILE:
            raise SourceError(f"{path}: more than {MAXIMUM_FILE} bytes")
        return parse_command_file(path.read_text("ascii", "replace"))
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}") from error
    except SourceError as error:
        raise SourceError(f"{path}: {error}") from None


def parse_commands(start: Iterable[str], stop: Iterable[str], periodic: Iterable[str]) -> ReceiverCommands:
    """Return the commands in lists of lines; SourceError names the line that is wrong."""
    return ReceiverCommands(
        tuple(step for line in start if (step := parse_line(line)) is not None),
        tuple(step for line in stop if (step := parse_line(line)) is not None),
        tuple(row for line in periodic if (row := parse_periodic(line)) is not None),
    )


def parse_command_file(text: str) -> ReceiverCommands:
    """Return the commands in the text of an RTKLIB command file; SourceError names the line that is wrong."""
    lines = text.splitlines()
    if len(lines) > MAXIMUM_LINES:
        raise SourceError(f"more than {MAXIMUM_LINES} lines")
    sections: list[list[tuple[int, str]]] = [[]]
    for number, line in enumerate(lines, 1):
        if line.startswith("@"):
            sections.append([])
        else:
            sections[-1].append((number, line))
    if len(sections) > _SECTIONS and any(sections[_SECTIONS:]):
        raise SourceError(f"line {sections[_SECTIONS][0][0]}: there are three sections, start, stop and periodic, with @ between them")
    sections += [[]] * _SECTIONS
    found = ReceiverCommands()
    for section, name in zip(sections, ("start", "stop", "periodic"), strict=False):
        for number, line in section:
            found += _numbered(number, {name: [line]})
    return found


def _numbered(number: int, lists: dict[str, list[str]]) -> ReceiverCommands:
    try:
        return parse_commands(lists.get("start", []), lists.get("stop", []), lists.get("periodic", []))
    except SourceError as error:
        raise SourceError(f"line {number}: {error}") from None


def parse_periodic(line: str) -> Periodic | None:
    """Return a periodic line's step and period, None for a comment."""
    command, mark, period = line.rpartition("#")
    if not mark or not command.strip():
        command, period = line, ""
    step = parse_line(command.strip())
    if step is None:
        return None
    try:
        period_s = float(period) * 1e-3 if period.strip() else DEFAULT_PERIOD_S
    except ValueError:
        raise SourceError(f"{line!r}: behind # stands the period in milliseconds") from None
    if not SHORTEST_PERIOD_S <= period_s <= 86400.0:
        raise SourceError(f"{line!r}: a period is from {SHORTEST_PERIOD_S * 1e3:.0f} ms to a day")
    return Periodic(step, period_s)


def parse_line(line: str) -> Step | None:
    """Return the step of a line, None for a comment; SourceError says what is wrong with it."""
    line = line.rstrip("\r\n")
    if not line.strip() or line.startswith("#"):
        return None
    if not line.startswith("!"):
        return Send(_text(line))
    word, _, rest = line.partition("#")[0].strip().partition(" ")
    try:
        return _special(word, rest.strip())
    except SourceError as error:
        raise SourceError(f"{line!r}: {error}") from None


def _special(word: str, rest: str) -> Step:
    if word == "!UBX" and rest:
        return Send(ubx_frame(rest))
    if word == "!HEX":
        return Send(_hexadecimal(rest))
    if word == "!WAIT":
        return Wait(min(LONGEST_WAIT_S, _whole(rest, "milliseconds") * 1e-3))
    if word == "!BRATE":
        return Baud(_whole(rest, "baud"))
    near = get_close_matches(word.upper(), _WORDS, 1)
    raise SourceError(f"{word} is no command{f'; did you mean {near[0]}?' if near else ''} (there are {', '.join(_WORDS)})")


def _text(line: str) -> bytes:
    try:
        return f"{line}\r\n".encode("ascii")
    except UnicodeEncodeError:
        raise SourceError(f"{line!r}: a receiver takes ASCII") from None


def _hexadecimal(text: str) -> bytes:
    try:
        data = bytes.fromhex("".join(word.lower().removeprefix("0x").zfill(2) for word in text.split()))
    except ValueError:
        data = b""
    if not data:
        raise SourceError("wants bytes as hexadecimal numbers")
    return data


def _whole(text: str, unit: str) -> int:
    if not text.isdecimal() or not 0 < int(text[:12]) < 10_000_000:
        raise SourceError(f"wants a whole number of {unit}")
    return int(text)
