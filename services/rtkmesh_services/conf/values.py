"""A value of a key, as RTKLIB understands it: names by their beginning, numbers by dialect; what it takes silently is told."""

from math import isfinite

from rtkmesh_services.conf.choices import Choices, Dialect
from rtkmesh_services.conf.rows import Kind, Row
from rtkmesh_services.errors import ConfError
from rtkmesh_services.runtime.words import clip, nearest

Value = str | float


def value_of(row: Row, text: str, dialect: Dialect) -> Value:
    """Return a value: the full name of a choice, a number, or the text. Empty is RTKLIB's 0, its first choice, or no text.

    ConfError says what is wrong, with the nearest right name.
    """
    text = text.strip()
    if row.kind is Kind.TEXT:
        return text
    if row.kind is Kind.INTEGER and row.choices is not None:  # an enumeration in 2.4, bits in demo5
        text = str(row.choices.old.get(text, text))
    elif row.choices is not None:
        return _choice(row, row.choices, text, dialect)
    try:
        value = float(text or "0")
    except ValueError:
        raise ConfError(f"{row.name}: {clip(text)!r} is no number") from None
    if not isfinite(value) or (row.kind is Kind.INTEGER and value != int(value)):
        raise ConfError(f"{row.name}: {clip(text)!r} is no {'whole ' if row.kind is Kind.INTEGER else ''}number")
    return value


def number_of(row: Row, text: str, dialect: Dialect) -> float:
    """Return the value of a number; ConfError if it is none."""
    value = value_of(row, text, dialect)
    assert not isinstance(value, str)  # the row is one of numbers
    return value


def _choice(row: Row, choices: Choices, text: str, dialect: Dialect) -> str:
    names = choices.of(dialect)
    if not text:
        return next(iter(names))
    if text.isdecimal():
        return _numbered(row, choices, int(text), dialect)
    text = choices.aliases.get(text, text)
    found = next((name for name in names if name.startswith(text)), None)
    if found is None:
        allowed = f"allowed are {', '.join(names)}{_other(choices, text, dialect)}"
        raise ConfError(f"{row.name}: no value {clip(text)!r}{nearest(text, list(names))}; {allowed}")
    return found


def _numbered(row: Row, choices: Choices, number: int, dialect: Dialect) -> str:
    names = choices.of(dialect)
    found = next((name for name, its in names.items() if its == number), None)
    if found is None:
        allowed = ", ".join(f"{its} {name}" for name, its in names.items())
        raise ConfError(f"{row.name}: no value {number} in {dialect}; allowed are {allowed}")
    return found


def _other(choices: Choices, text: str, dialect: Dialect) -> str:
    other: Dialect = "2.4" if dialect == "demo5" else "demo5"
    there = any(name.startswith(text) for name in choices.of(other))
    return f" ({other} has it: say --dialect {other})" if there else ""
