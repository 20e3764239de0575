"""What became of each key of a file, and the tables that it gives: what an import gathers on its way."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

from rtkmesh_services.conf.conf_file import ConfFile
from rtkmesh_services.conf.rows import Fate
from rtkmesh_services.conf.table import ALL_ROWS

MASKED: Final = "***"
_SECRET_KEYS: Final = ("console-passwd",)
Path = tuple[str, ...]


class Became(StrEnum):
    """What became of a key."""

    TAKEN = Fate.TAKEN.value
    TRANSLATED = Fate.TRANSLATED.value
    IGNORED = Fate.IGNORED.value
    DEFAULT = "default"


@dataclass(frozen=True, slots=True)
class ReportRow:
    """One key. ``line`` None: the file does not say it. ``alters``: rtkmesh does not do what the key asks for."""

    key: str
    line: int | None
    value: str
    became: Became
    target: str
    note: str
    alters: bool = False


@dataclass(slots=True)
class Draft:
    """The deployment that is being made of a file. ``secrets``: variables of the environment -> what belongs into them."""

    conf: ConfFile
    solver_id: str
    prefix: str
    tables: dict[str, Any] = field(default_factory=dict[str, Any])
    rows: dict[str, ReportRow] = field(default_factory=dict[str, ReportRow])
    origins: dict[Path, int] = field(default_factory=dict[Path, int])
    secrets: dict[str, str] = field(default_factory=dict[str, str])
    open: dict[str, str] = field(default_factory=dict[str, str])
    notes: list[str] = field(default_factory=list[str])

    def id_of(self, name: str) -> str:
        """Return the id of a process: its usual name behind the prefix."""
        return f"{self.prefix}{name}"

    def put(self, path: Path, value: Any, *keys: str) -> None:
        """Enter a value of the deployment; ``keys`` are those that it comes from."""
        table = self.tables
        for name in path[:-1]:
            table = table.setdefault(name, {})
        table[path[-1]] = value
        if (line := self.conf.line_of(*keys)) is not None:
            self.origins[path] = line

    def get(self, path: Path) -> Any:
        """Return a value of the deployment, or None."""
        value: Any = self.tables
        for name in path:
            value = value.get(name) if isinstance(value, dict) else None  # pyright: ignore[reportUnknownVariableType, reportUnknownMemberType]  any TOML
        return value  # pyright: ignore[reportUnknownVariableType]  as above

    def note(self, key: str, became: Fate | Became, target: str, note: str = "", *, alters: bool = False) -> None:
        """Say what became of a key; a later word replaces an earlier one. A key that the file does not have stays a default."""
        line = self.conf.line_of(key)
        value = self.shown_value(key)
        became = Became.DEFAULT if line is None else Became(became.value)
        self.rows[key] = ReportRow(key, line, value, became, target, note, alters)

    def shown_value(self, key: str) -> str:
        """Return a key's value without what is nobody's business."""
        text = self.conf.text(key)
        if key in _SECRET_KEYS and text:
            return MASKED
        if key.endswith("-path") and "@" in text:
            user, colon, _ = text.rpartition("@")[0].partition(":")
            return f"{user}{colon}{MASKED if colon and text.rpartition('@')[0] != ':' else ''}@{text.rpartition('@')[2]}"
        return text

    def secret(self, name: str, value: str) -> str:
        """Return a reference to the environment that stands for a secret."""
        name = name.upper()
        self.secrets[name] = value
        return f"${{{name}}}"

    def placeholder(self, name: str, wanted: str) -> str:
        """Return a reference to the environment for something that the file does not say."""
        name = name.upper()
        self.open[name] = wanted
        return f"${{{name}}}"

    def finished(self) -> list[ReportRow]:
        """Return what became of every key of the dialect, in RTKLIB's order."""
        for name, row in ALL_ROWS.items():
            if name not in self.rows and row.known_to(self.conf.dialect):
                self.note(name, row.fate, row.target, row.why)
        return [self.rows[name] for name in ALL_ROWS if name in self.rows]
