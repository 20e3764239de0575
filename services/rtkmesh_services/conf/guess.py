"""Which dialect a file is written in: by keys, words and enumerations that only one of them has."""

import re
from collections import Counter
from dataclasses import dataclass
from typing import Final

from rtkmesh_services.conf.choices import DIALECTS, Dialect
from rtkmesh_services.conf.parser import Line
from rtkmesh_services.conf.table import ALL_ROWS

DEFAULT: Final[Dialect] = "demo5"
_OLD_KEYS: Final = ("pos1-snrmask", "stats-errratio")  # of 2.4.1
_ENUMERATION: Final = re.compile(r"(\d+):([a-z0-9][^,()]*)")
_TITLES: Final[tuple[tuple[re.Pattern[str], Dialect], ...]] = (
    (re.compile(r"demo5|rtklibexplorer|\bEX[ _]?2\.5", re.IGNORECASE), "demo5"),
    (re.compile(r"\bv(?:er)?\.? ?2\.4\.\d"), "2.4"),
)


@dataclass(frozen=True, slots=True)
class Evidence:
    """Something that only one dialect has. ``weight``: how sure it is."""

    dialect: Dialect
    line: int | None
    reason: str
    weight: int = 2


@dataclass(frozen=True, slots=True)
class Guess:
    """The dialect with what speaks for it, and against."""

    dialect: Dialect
    why: str
    against: str = ""


def guess_dialect(lines: list[Line], comments: list[str]) -> Guess:
    """Return the dialect that most of a file speaks for; the text says why, and what speaks against it."""
    found = [*_titles(comments), *(evidence for line in lines for evidence in _of_line(line))]
    weight = Counter[Dialect]()
    for evidence in found:
        weight[evidence.dialect] += evidence.weight
    if not found:
        return Guess(DEFAULT, "nothing in the file is of one dialect alone")
    best = max(DIALECTS, key=lambda dialect: (weight[dialect], dialect == DEFAULT))
    return Guess(best, _reasons(found, best), _reasons([row for row in found if row.dialect != best], None))


def _reasons(found: list[Evidence], dialect: Dialect | None) -> str:
    rows = [evidence for evidence in found if dialect in (None, evidence.dialect)]
    shown = [f"{row.reason}{f' (line {row.line})' if row.line else ''}" for row in rows[:3]]
    more = [f"{len(rows) - 3} more"] if len(rows) > 3 else []
    return ", ".join([*shown, *more])


def _titles(comments: list[str]) -> list[Evidence]:
    for pattern, dialect in _TITLES:
        for comment in comments:
            if match := pattern.search(comment):
                return [Evidence(dialect, None, f"its title says {match[0]!r}", 1)]
    return []


def _of_line(line: Line) -> list[Evidence]:
    row = ALL_ROWS.get(line.key)
    if row is None:
        return [Evidence("2.4", line.number, f"{line.key} is a key of 2.4.1")] if line.key in _OLD_KEYS else []
    found: list[Evidence] = []
    if row.only is not None:
        found.append(Evidence(row.only, line.number, f"{row.name} is a key of {row.only} alone"))
    if row.choices is None:
        return found
    found += _listed(line)
    text = line.value if not line.value.isdecimal() else ""
    there: list[Dialect] = [dialect for dialect in DIALECTS if any(name.startswith(text) for name in row.choices.of(dialect))]
    alias = row.choices.aliases.get(text)
    if text and alias is None and len(there) == 1 and row.choices.demo5:
        found.append(Evidence(there[0], line.number, f"{row.name}={text} is of {there[0]} alone"))
    elif text.startswith("l1+2"):
        found.append(Evidence("2.4", line.number, f"{row.name}={text} is of 2.4.3 alone"))
    return found


def _listed(line: Line) -> list[Evidence]:
    """The enumeration that RTKLIB writes behind a value: ``(0:single,...,4:movingbase)``."""
    choices = ALL_ROWS[line.key].choices
    assert choices is not None  # the caller has looked
    told = {name.strip(): int(number) for number, name in _ENUMERATION.findall(line.comment)}
    differing = [name for name in told if name in choices.demo5 and name in choices.old and choices.demo5[name] != choices.old[name]]
    for dialect in DIALECTS:
        names = [name for name in differing if choices.of(dialect)[name] == told[name]]
        if names:
            return [Evidence(dialect, line.number, f"its list for {line.key} has {told[names[0]]}:{names[0]}", 3)]
    return []
