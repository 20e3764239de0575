"""What a row of the table of keys is."""

from dataclasses import dataclass
from enum import StrEnum

from rtkmesh_services.conf.choices import Choices, Dialect


class Kind(StrEnum):
    """What a value is."""

    NUMBER = "number"
    INTEGER = "integer"
    TEXT = "text"
    CHOICE = "choice"


class Fate(StrEnum):
    """What becomes of a key."""

    TAKEN = "taken"
    TRANSLATED = "translated"
    IGNORED = "ignored"


@dataclass(frozen=True, slots=True)
class Row:
    """One key: its values, what RTKLIB uses without it, and what becomes of it here.

    ``default`` is demo5's, ``old_default`` that of 2.4.2 where it differs. ``only``: the dialect that has it. ``target``: where it goes
    in the deployment file. ``why``: how it is translated, or why it is ignored. ``tuning``: a number of RTKLIB's filter: its default
    is no wish of the file's author, and ours is measured to be better.
    """

    name: str
    kind: Kind
    default: str
    fate: Fate
    target: str = ""
    why: str = ""
    old_default: str | None = None
    choices: Choices | None = None
    only: Dialect | None = None
    tuning: bool = False

    def default_of(self, dialect: Dialect) -> str:
        """Return the value that RTKLIB uses when a file does not say it."""
        return self.default if dialect == "demo5" or self.old_default is None else self.old_default

    def known_to(self, dialect: Dialect) -> bool:
        """Return whether a dialect has the key."""
        return self.only is None or self.only == dialect
