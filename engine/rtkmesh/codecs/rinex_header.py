"""What the headers of all RINEX files share: the first line, the label of each line, Fortran numbers."""

from collections.abc import Iterator
from typing import Final

from rtkmesh.errors import FormatError

_LABEL: Final = 60  # column of the label (RINEX 3.05 table A2)
_MAX_HEADER_LINES: Final = 5000


def as_bytes(text: str | bytes) -> bytes:
    """Return the text of a RINEX file as bytes (Latin-1: names may hold anything)."""
    return text.encode("latin-1", "replace") if isinstance(text, str) else bytes(text)


def header_lines(text: bytes) -> tuple[list[tuple[str, str]], int]:
    """Return the header's lines as (content of columns 1-60, label) and the offset of the first byte behind the header.

    FormatError if the first line is not that of a RINEX file or the header has no end.
    """
    if text[_LABEL : _LABEL + 20] != b"RINEX VERSION / TYPE":
        raise FormatError("the first line has no label 'RINEX VERSION / TYPE'")
    lines: list[tuple[str, str]] = []
    offset = 0
    while len(lines) < _MAX_HEADER_LINES:
        end = text.find(b"\n", offset)
        if end < 0:
            break
        line = text[offset:end].decode("latin-1")
        offset, label = end + 1, line[_LABEL:].strip()
        if label == "END OF HEADER":
            return lines, offset
        lines.append((line[:_LABEL], label))
    raise FormatError("the header has no line 'END OF HEADER'")


def version_and_type(first: str) -> tuple[float, str, str]:
    """Return version, file type letter and system letter (blank is GPS) of the first line; FormatError if there is no version."""
    version = number(first[:9])
    if not 2.0 <= version < 5.0:
        raise FormatError(f"{first[:9].strip() or 'nothing'!r} is no known RINEX version (2.00 to 4.02)")
    return version, first[20:21], first[40:41].strip() or "G"


def number(field: str, default: float = 0.0) -> float:
    """Return a Fortran number (exponent E or D, blanks, no leading zero), ``default`` where it is blank or no number."""
    try:
        return float(field)
    except ValueError:
        pass
    try:
        return float(field.strip().upper().replace("D", "E"))
    except ValueError:
        return default


def integer(field: str, default: int = 0) -> int:
    """Return a Fortran integer, ``default`` where it is blank or no number."""
    try:
        return int(field)
    except ValueError:
        return default


def numbers(content: str, width: int, start: int = 0) -> Iterator[float]:
    """Yield the Fortran numbers of a line of fixed fields."""
    for offset in range(start, len(content), width):
        yield number(content[offset : offset + width])
