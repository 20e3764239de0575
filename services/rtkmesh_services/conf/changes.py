"""What one key does to a solver's table."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rtkmesh_schemas.config import SolverTable
from rtkmesh_services.conf.choices import Dialect
from rtkmesh_services.conf.rows import Fate, Row


@dataclass(frozen=True, slots=True)
class Change:
    """``values``: dotted key of the solver's table -> value. ``alters``: what the file asks for is not what we do."""

    fate: Fate
    note: str = ""
    values: dict[str, Any] = field(default_factory=dict[str, Any])
    alters: bool = False


Setter = Callable[[SolverTable, Row, str, Dialect], Change]


def taken(note: str = "", **values: Any) -> Change:
    """A value that means the same here. ``a__b`` is the key a.b."""
    return Change(Fate.TAKEN, note, {name.replace("__", "."): value for name, value in values.items()})


def translated(note: str, **values: Any) -> Change:
    """A value that means nearly the same here."""
    return Change(Fate.TRANSLATED, note, {name.replace("__", "."): value for name, value in values.items()})


def ignored(note: str, *, alters: bool) -> Change:
    """A value that does nothing here."""
    return Change(Fate.IGNORED, note, alters=alters)
