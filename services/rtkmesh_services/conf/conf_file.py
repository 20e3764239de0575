"""A .conf file as RTKLIB understands it: the last line of each key, by the key that RTKLIB takes its name for."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from rtkmesh_services.conf.choices import Dialect
from rtkmesh_services.conf.guess import Guess, guess_dialect
from rtkmesh_services.conf.parser import MAXIMUM_FILE, Line, Said, read_lines
from rtkmesh_services.conf.rows import Kind, Row
from rtkmesh_services.conf.table import ALL_ROWS, row_like
from rtkmesh_services.conf.values import value_of
from rtkmesh_services.errors import ConfError
from rtkmesh_services.runtime.words import clip, nearest

OURS: Final = "written by rtkmesh"  # in the title of a file that we exported: all of its values are meant
_SHORTEST: Final = 4
_REFERENCES: Final = ("${", "{data}")
_ALIAS: Final = "pos2-rejionno"

DialectWish = Literal["auto", "2.4", "demo5"]


@dataclass(slots=True)
class ConfFile:
    """``lines``: name of the row -> its line that counts. ``said``: what there is to say of single lines."""

    name: str
    guess: Guess
    lines: dict[str, Line] = field(default_factory=dict[str, Line])
    said: list[Said] = field(default_factory=list[Said])
    ours: bool = False
    version: str = ""

    @property
    def dialect(self) -> Dialect:
        """The dialect that its numbers are understood in."""
        return self.guess.dialect

    @property
    def wrong(self) -> list[Said]:
        """What is wrong in the file, by line."""
        return sorted((row for row in self.said if row.wrong), key=lambda row: row.line or 0)

    def text(self, name: str) -> str:
        """Return the value of a key, or what RTKLIB uses without it."""
        line = self.lines.get(name)
        return ALL_ROWS[name].default_of(self.dialect) if line is None else line.value

    def choice(self, name: str) -> str:
        """Return the full name of a choice: the default where the file's is wrong (told when the file was read)."""
        row = ALL_ROWS[name]
        return str(value_of(row, self.text(name), self.dialect))

    def number(self, name: str) -> float:
        """Return the value of a number."""
        value = value_of(ALL_ROWS[name], self.text(name), self.dialect)
        return 0.0 if isinstance(value, str) else value

    def line_of(self, *names: str) -> int | None:
        """Return the line of the first of some keys that the file has."""
        return next((self.lines[name].number for name in names if name in self.lines), None)

    def say(self, name: str, message: str, *, wrong: bool = False) -> None:
        """Add something about a key."""
        self.said.append(Said(self.line_of(name), name, message, wrong))


def read_conf(path: Path, dialect: DialectWish = "auto") -> ConfFile:
    """Return a .conf file; ConfError if it cannot be read at all."""
    try:
        if path.stat().st_size > MAXIMUM_FILE:
            raise ConfError(f"{path}: more than {MAXIMUM_FILE} bytes")
        data = path.read_bytes()
    except OSError as error:
        raise ConfError(f"{path}: {error.strerror}") from error
    try:
        return parse_conf(data, str(path), dialect)
    except ConfError as error:
        raise ConfError(f"{path}: {error}") from None


def parse_conf(data: bytes, name: str, dialect: DialectWish = "auto") -> ConfFile:
    """Return the .conf file in some bytes; ConfError for what is no text at all."""
    lines, comments, said = read_lines(data)
    guess = guess_dialect(lines, comments) if dialect == "auto" else Guess(dialect, "as told")
    title = " ".join(comments[:3])
    conf = ConfFile(name, guess, said=said, ours=OURS in title, version="2.4.3" if "2.4.3" in title else "")
    for line in lines:
        _enter(conf, line)
    return conf


def _enter(conf: ConfFile, line: Line) -> None:
    row = _row(conf, line)
    if row is None:
        return
    if (before := conf.lines.get(row.name)) is not None:
        conf.said.append(Said(line.number, row.name, f"{row.name} again: this line counts, not line {before.number}"))
        del conf.lines[row.name]  # it takes its new place: the later one of two that alter the same
    try:
        _ = value_of(row, line.value, conf.dialect)
    except ConfError as error:
        default = row.default_of(conf.dialect)
        conf.said.append(Said(line.number, row.name, f"{error}; RTKLIB goes on with {default or 'nothing'!r}", wrong=True))
        return
    conf.lines[row.name] = line
    _tell_traps(conf, row, line)


def _row(conf: ConfFile, line: Line) -> Row | None:
    row = ALL_ROWS.get(line.key)
    if row is not None and row.known_to(conf.dialect):
        return row
    if row is not None:
        conf.said.append(Said(line.number, row.name, f"{row.name} is a key of {row.only}: {conf.dialect} passes over it"))
        return None
    like = row_like(line.key, conf.dialect) if len(line.key) >= _SHORTEST else None
    if like is None:
        message = f"no key {clip(line.key)!r}{nearest(line.key, list(ALL_ROWS))}: RTKLIB passes over it"
        conf.said.append(Said(line.number, line.key, message, wrong=True))
    else:
        conf.said.append(Said(line.number, like.name, f"{clip(line.key)!r} is no key: RTKLIB takes it for {like.name}, as we do"))
    return like


def _tell_traps(conf: ConfFile, row: Row, line: Line) -> None:
    if line.blank and row.kind is Kind.CHOICE:
        conf.say(row.name, f"{row.name}: RTKLIB does not know {line.value!r} with the blank before it and uses its default; here it counts")
    elif line.blank and row.kind is Kind.TEXT:
        conf.say(row.name, f"{row.name}: RTKLIB keeps the blank before the text; here it is left out")
    if any(mark in line.value for mark in _REFERENCES):
        conf.say(row.name, f"{row.name}: ${{NAME}} and {{data}} are replaced in a deployment file, RTKLIB takes them as they are")
    if row.kind is Kind.CHOICE and row.choices is not None and line.value.isdecimal() and int(line.value) in row.choices.differing:
        conf.say(
            row.name, f"{row.name}: {line.value} is {value_of(row, line.value, conf.dialect)} in {conf.dialect}, not in the other dialect"
        )
    if row.name == _ALIAS and conf.dialect == "demo5" and line.value == "30":
        conf.say(row.name, "pos2-rejionno: 30 is 2.4's value; demo5 takes it as a limit of phases, which then rejects none")
