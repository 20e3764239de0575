"""A solver's table in RTKLIB's words, and one of RTKLIB's keys put into it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from rtkmesh_schemas.config import SolverTable
from rtkmesh_services.conf.choices import Dialect
from rtkmesh_services.conf.rows import Fate, Row
from rtkmesh_services.conf.rows_positioning import ROWS
from rtkmesh_services.conf.solver_setters import MODES, SYSTEM_BITS, change_of, effective, with_values
from rtkmesh_services.errors import ConfError
from rtkmesh_services.runtime.words import clip, nearest

SOLVER_ROWS: Final = {row.name: row for row in ROWS}
_NAMES: Final = {ours: rtklib for rtklib, ours in MODES.items()}
_FREQUENCIES: Final = ("l1", "l1+l2", "l1+l2+l5", "l1+l2+l5+l6", "l1+l2+l5+l6+l7")
_MASKS: Final = ("L1", "L2", "L5", "L6")


@dataclass(frozen=True, slots=True)
class ConfLine:
    """A line of a .conf file."""

    key: str
    value: str
    comment: str = ""

    def __str__(self) -> str:
        line = f"{self.key:<18} ={self.value}"
        return f"{line:<31} # {self.comment}" if self.comment else line


Writer = Callable[[SolverTable, Dialect], tuple[str, str]]


def solver_options(table: SolverTable, dialect: Dialect = "demo5") -> list[ConfLine]:
    """Return RTKLIB's keys that a solver's table has a meaning for, in RTKLIB's order, with a comment where the meaning is not the same."""
    lines: list[ConfLine] = []
    for row in ROWS:
        if row.name in _WRITERS and row.known_to(dialect):
            value, comment = _WRITERS[row.name](table, dialect)
            lines.append(ConfLine(row.name, value, comment))
    return lines


def with_solver_option(table: SolverTable, key: str, value: str, dialect: Dialect = "demo5") -> tuple[SolverTable, str]:
    """Return the table with one of RTKLIB's keys set, and a note of how it is understood; ConfError names what is wrong with key or value.

    A key that does nothing here is accepted where its value is what is done anyway, and refused with the reason where it is not.
    """
    row = row_of(key, dialect)
    change = change_of(table, row, value, dialect)
    if change.fate is Fate.IGNORED and change.alters:
        raise ConfError(f"{row.name}: cannot be set here: {change.note}")
    return with_values(table, row.name, change.values), change.note


def row_of(key: str, dialect: Dialect) -> Row:
    """Return the row of a solver's key; ConfError with the nearest right name."""
    row = SOLVER_ROWS.get(key.strip())
    if row is None:
        raise ConfError(f"no key {clip(key)!r}{nearest(key, list(SOLVER_ROWS))}")
    if not row.known_to(dialect):
        raise ConfError(f"{row.name}: a key of {row.only}, not of {dialect}")
    return row


def number_text(value: float) -> str:
    """Return a number as RTKLIB writes it."""
    return f"{value:.10g}"


def _of(path: str) -> Writer:
    def write(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
        value = effective(table, path)
        return (value if isinstance(value, str) else number_text(value)), ""

    return write


def _mode(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    if table.mode == "static-start" and dialect == "2.4":
        return "static", "static-start is not in 2.4"
    return _NAMES[table.mode], ""


def _frequency(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    count = min(table.frequencies, 4 if dialect == "demo5" else 5)
    comment = "" if count == table.frequencies else f"of {table.frequencies}"
    if dialect == "2.4":  # the names differ between 2.4.2 (l1+l2) and 2.4.3 (l1+2), the numbers do not
        return str(count), _FREQUENCIES[count - 1]
    return _FREQUENCIES[count - 1], comment


def _systems(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return str(sum(SYSTEM_BITS[letter] for letter in set(table.systems))), table.systems


def _excluded(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return " ".join(f"S{100 + int(name[1:])}" if name[0] == "S" else name for name in table.excluded), ""


def _mask(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return ",".join([number_text(table.cn0_mask_dbhz)] * 9), ""


def _mask_switch(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return "on" if table.cn0_mask_dbhz else "off", ""


def _least(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return str(effective(table, "ambiguity.minimum_ambiguities") + 1), ""


def _length(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return number_text(table.baseline_length_m or 0.0), ""


def _length_sigma(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return number_text(table.baseline_sigma_m if table.baseline_length_m else 0.0), ""


def _sync(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return "on" if table.sync.matched_only else "off", "rtkrcv_ros waits for equal epochs, RTKLIB does nothing" * table.sync.matched_only


def _interpolation(table: SolverTable, dialect: Dialect) -> tuple[str, str]:
    return "on" if table.sync.interpolate else "off", ""


def _said(value: str, comment: str = "") -> Writer:
    return lambda table, dialect: (value, comment)


def _by_dialect(demo5: str, old: str) -> Writer:
    return lambda table, dialect: (demo5 if dialect == "demo5" else old, "")


_WRITERS: Final[dict[str, Writer]] = {
    "pos1-posmode": _mode,
    "pos1-frequency": _frequency,
    "pos1-elmask": _of("elevation_mask_deg"),
    "pos1-snrmask_r": _mask_switch,
    "pos1-snrmask_b": _mask_switch,
    **{f"pos1-snrmask_{band}": _mask for band in _MASKS},
    "pos1-dynamics": _said("on"),
    "pos1-tidecorr": _by_dialect("1", "on"),
    "pos1-ionoopt": _said("brdc"),
    "pos1-tropopt": _said("saas"),
    "pos1-sateph": _said("brdc"),
    "pos1-posopt2": _said("on"),
    "pos1-posopt5": _said("on"),
    "pos1-exclsats": _excluded,
    "pos1-navsys": _systems,
    "pos2-armode": _of("ambiguity.mode"),
    "pos2-gloarmode": _by_dialect("fix-and-hold", "on"),
    "pos2-bdsarmode": _said("on"),
    "pos2-arthres": _of("ambiguity.ratio"),
    "pos2-arlockcnt": _of("ambiguity.minimum_lock_epochs"),
    "pos2-minfixsats": _least,
    "pos2-arelmask": _of("ambiguity.elevation_mask_deg"),
    "pos2-arminfix": _of("ambiguity.hold_after_epochs"),
    "pos2-maxage": _of("max_age_s"),
    "pos2-syncsol": _sync,
    "pos2-baselen": _length,
    "pos2-basesig": _length_sigma,
    "stats-eratio1": _of("noise.code_ratio"),
    "stats-eratio2": _of("noise.code_ratio"),
    "stats-eratio5": _of("noise.code_ratio"),
    "stats-eratio6": _of("noise.code_ratio"),
    "stats-errphase": _of("noise.phase_a_m"),
    "stats-errphaseel": _of("noise.phase_b_m"),
    "stats-prnaccelh": _of("dynamics.acceleration_horizontal_mps2"),
    "stats-prnaccelv": _of("dynamics.acceleration_vertical_mps2"),
    "stats-prnbias": _of("dynamics.ambiguity_cyc"),
    "misc-timeinterp": _interpolation,
}
