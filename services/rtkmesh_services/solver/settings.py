"""A solver's options as they are, as they will be after a restart, and in files: for ``set``, ``option``, ``load`` and ``save``."""

from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

import msgspec

from rtkmesh.rtk.continuation import Continuation
from rtkmesh_schemas.command import Code
from rtkmesh_schemas.config import SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.conf.solver_keys import SOLVER_ROWS, solver_options, with_solver_option
from rtkmesh_services.conf.solver_setters import effective
from rtkmesh_services.errors import CommandError, ConfError
from rtkmesh_services.runtime.configuration import MAXIMUM_SOLVER_FILE, load_solver_table
from rtkmesh_services.runtime.files_below import read_below, write_below
from rtkmesh_services.runtime.toml_text import toml_table
from rtkmesh_services.runtime.words import clip, nearest
from rtkmesh_services.solver.options import WIRING, is_option, options_of, shown, with_option

# Keys of RTKLIB's files that are of streams, outputs and programs, not of a solver.
_ELSEWHERE: Final = ("inpstr", "outstr", "logstr", "console-", "out-", "misc-", "file-", "ant1-", "ant2-")

GoOn = Callable[[SolverTable], Continuation]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of changed options. ``changes``: name -> (old, new); ``obstacle``: why they wait for a restart; ``note``: how a key of
    RTKLIB is understood.
    """

    at_once: bool
    changes: dict[str, tuple[Any, Any]]
    continuation: Continuation
    note: str = ""

    def data(self) -> dict[str, Any]:
        """Return the outcome for ``Reply.data``."""
        return {
            "applied": "at_once" if self.at_once else "on_restart",
            "changes": {name: {"old": old, "new": new} for name, (old, new) in self.changes.items()},
            "kept": list(self.continuation.kept),
            "anew": list(self.continuation.anew),
            **({} if self.at_once else {"reason": self.continuation.obstacle}),
            **({"note": self.note} if self.note else {}),
        }


class Settings:
    """``active`` is what the engine runs under; ``pending`` what it will after a restart.

    ``check`` raises ConfigError for a table that the engine refuses; ``go_on`` tries one on the running filter.
    """

    def __init__(self, table: SolverTable, check: Callable[[SolverTable], object], go_on: GoOn) -> None:
        self.active = self.pending = self.configured = table
        self._check, self._go_on = check, go_on

    @property
    def waiting(self) -> int:
        """How many options wait for a restart."""
        return 0 if self.pending == self.active else sum("pending" in option for option in self.told("").values())

    def restarted(self) -> None:
        """A fresh filter has taken what was pending."""
        self.active = self.pending

    def take_base(self, table: SolverTable) -> None:
        """The base of this table is used now, whatever else waits for a restart."""
        rewired = {"base": table.base, "base_antenna": table.base_antenna}
        self.active, self.pending, self.configured = (
            msgspec.structs.replace(one, **rewired) for one in (self.active, self.pending, self.configured)
        )

    def set(self, name: str, value: Any, dialect: Any = "demo5") -> Outcome:
        """Change one option, named as in our files or as in RTKLIB's; CommandError says what is wrong."""
        if is_option(name, self.pending) or name in WIRING or name not in SOLVER_ROWS:
            named = name if is_option(name, self.pending) or name in WIRING else self._known(name)
            return self._changed(with_option(self.pending, named, value), with_option(self.active, named, value))
        if dialect not in ("demo5", "2.4"):
            raise CommandError(Code.BAD_ARGUMENTS, f"dialect is demo5 or 2.4, not {clip(str(dialect))!r}")
        text = shown(value)
        try:
            pending, note = with_solver_option(self.pending, name, text, dialect)
            active, _ = with_solver_option(self.active, name, text, dialect)
        except (ConfError, ConfigError) as error:
            raise CommandError(Code.BAD_ARGUMENTS, f"invalid option value: {name} {clip(text)} ({error})") from error
        return self._changed(pending, active, note)

    def load(self, file: str, folder: Path) -> Outcome:
        """Take the options of a file below the folder, TOML or RTKLIB's .conf; streams stay. ConfigError says what is wrong."""
        table, note = conf_table(file, folder, self.pending) if file.endswith(".conf") else (load_solver_table(file, folder), "")
        table = with_streams(table, self.pending)
        return self._changed(table, table, note)

    def save(self, file: str, folder: Path, *, overwrite: bool) -> int:
        """Write the present options (those after a restart) into a file that ``load`` reads; return its bytes. ConfigError if it fails."""
        if file.endswith(".conf"):
            text = "".join(f"{line}\n" for line in solver_options(self.pending))
        elif file.endswith(".toml"):
            text = toml_table("solver", self.pending)
        else:
            raise ConfigError(clip(file), None, "a file of options ends in .toml, or in .conf for RTKLIB's")
        write_below(file, folder, text.encode(), overwrite=overwrite)
        return len(text.encode())

    def told(self, pattern: str) -> dict[str, dict[str, Any]]:
        """Return the options whose names have ``pattern`` in them (``*`` and ``?`` as in files' names): what is used, and what waits."""
        now, then = options_of(self.active), options_of(self.pending)
        wanted = f"*{pattern}*" if pattern else "*"
        return {
            name: {
                "value": effective(self.active, name),
                **({"pending": effective(self.pending, name)} if then[name] != now[name] else {}),
            }
            for name in now
            if fnmatchcase(name, wanted)
        }

    def _known(self, name: str) -> str:
        names = [*options_of(self.pending), *SOLVER_ROWS]
        raise CommandError(Code.NOT_FOUND, f"no option type: {clip(name)}{nearest(name, names)}")

    def _changed(self, pending: SolverTable, active: SolverTable, note: str = "") -> Outcome:
        """Try the changed table on the filter; where that cannot be, it waits for a restart."""
        self._check(pending)
        before, after = options_of(self.pending), options_of(pending)
        changes = {name: (before[name], after[name]) for name in after if before[name] != after[name]}
        found = self._go_on(active)
        self.pending = pending
        if not found.obstacle:
            self.active = active
        return Outcome(not found.obstacle, changes, found, note)


def with_streams(table: SolverTable, current: SolverTable) -> SolverTable:
    """Return a loaded table with the streams of the running one: options change, not wiring."""
    return msgspec.structs.replace(table, **{name: getattr(current, name) for name in WIRING})


def conf_table(file: str, folder: Path, table: SolverTable) -> tuple[SolverTable, str]:
    """Return a table with the solver's keys of RTKLIB's file, and what of the file was left aside; ConfigError with the line."""
    text = read_below(file, folder, MAXIMUM_SOLVER_FILE).decode("ascii", "replace")
    aside = 0
    for number, line in enumerate(text.splitlines(), 1):
        key, sign, value = (part.strip() for part in line.partition("#")[0].partition("="))
        if not sign:
            continue
        if key.startswith(_ELSEWHERE) and key not in SOLVER_ROWS:
            aside += 1
            continue
        try:
            table, _ = with_solver_option(table, key, value)
        except (ConfError, ConfigError) as error:
            raise ConfigError(file, number, str(error)) from error
    return table, f"{aside} keys of streams, outputs and files were left aside" if aside else ""
