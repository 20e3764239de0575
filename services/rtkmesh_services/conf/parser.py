"""The text of a .conf file -> its lines. As tolerant as RTKLIB where files in the wild need it; what it passes over silently is told."""

import re
from dataclasses import dataclass
from typing import Final

from rtkmesh_services.errors import ConfError
from rtkmesh_services.runtime.words import clip

MAXIMUM_FILE: Final = 1 << 20
LONGEST_LINE: Final = 2047  # RTKLIB reads a longer one as two
_NEWLINE: Final = re.compile(r"\r\n|\n|\r")


@dataclass(frozen=True, slots=True)
class Said:
    """Something about a line: ``wrong`` where it does nothing, in RTKLIB or here."""

    line: int | None
    key: str
    message: str
    wrong: bool = False

    def shown(self, file: str) -> str:
        """Return ``file:line: message``."""
        return f"{file}:{self.line}: {self.message}" if self.line else f"{file}: {self.message}"


@dataclass(frozen=True, slots=True)
class Line:
    """``key = value # comment``; ``blank``: the value begins with a blank, which RTKLIB keeps."""

    number: int
    key: str
    value: str
    comment: str
    blank: bool = False


def read_lines(data: bytes) -> tuple[list[Line], list[str], list[Said]]:
    """Return the lines with a key, the comments that stand alone, and what there is to say; ConfError for what is no text."""
    text, said = _text(data)
    lines: list[Line] = []
    comments: list[str] = []
    for number, raw in enumerate(_NEWLINE.split(text), 1):
        content, hash_, comment = raw.partition("#")
        if len(raw.encode()) > LONGEST_LINE:
            said.append(Said(number, "", f"more than {LONGEST_LINE} bytes: RTKLIB reads it as two lines", wrong=True))
        elif "=" in content:
            lines.append(_line(number, content, comment.strip()))
        elif content.strip():
            said.append(Said(number, "", f"{clip(content.strip())!r} has no '=': RTKLIB passes over it", wrong=True))
        elif hash_:
            comments.append(comment.strip())
    return lines, comments, said


def _line(number: int, content: str, comment: str) -> Line:
    key, _, value = content.partition("=")
    return Line(number, key.strip(), value.strip(), comment, blank=value[:1] in (" ", "\t") and bool(value.strip()))


def _text(data: bytes) -> tuple[str, list[Said]]:
    if len(data) > MAXIMUM_FILE:
        raise ConfError(f"more than {MAXIMUM_FILE} bytes")
    if b"\0" in data:
        raise ConfError("has zero bytes: no text")
    try:
        return data.decode("utf-8-sig"), []
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        return data.decode("latin-1"), [Said(line, "", "is no UTF-8: read as Latin-1")]
