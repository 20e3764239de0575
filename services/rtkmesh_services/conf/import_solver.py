"""The solver's keys of a .conf file -> the table [solver.ID]."""

from typing import Any, Final

from rtkmesh_schemas.config import SolverTable
from rtkmesh_services.conf.changes import Change
from rtkmesh_services.conf.report import Draft
from rtkmesh_services.conf.rows import Fate, Row
from rtkmesh_services.conf.rows_positioning import ROWS
from rtkmesh_services.conf.solver_keys import number_text
from rtkmesh_services.conf.solver_setters import change_of, effective, mask_values, with_values
from rtkmesh_services.conf.table import ALL_ROWS
from rtkmesh_services.conf.values import value_of
from rtkmesh_services.errors import ConfError

# keys whose default in RTKLIB is the file's meaning when it does not say them
_MEANT: Final = ("pos1-posmode", "pos1-frequency", "pos1-elmask", "pos1-navsys", "pos2-maxage")
_ACCELERATIONS: Final = ("stats-prnaccelh", "stats-prnaccelv")
_MASKS: Final = ("pos1-snrmask_L1", "pos1-snrmask_L2", "pos1-snrmask_L5", "pos1-snrmask_L6")
_BLANK: Final = SolverTable(rover="", base="")
_MASK_SWITCHES: Final = ("pos1-snrmask_r", "pos1-snrmask_b")


def import_solver(draft: Draft) -> SolverTable:
    """Enter the solver's table and say what became of its keys."""
    table = SolverTable(rover=draft.id_of("rover"), base=draft.id_of("base"))
    draft.put(("solver", draft.solver_id, "rover"), table.rover)
    draft.put(("solver", draft.solver_id, "base"), table.base)
    for row in ROWS:
        if row.known_to(draft.conf.dialect) and row.name not in (*_MASKS, *_MASK_SWITCHES):
            table = _entered(draft, table, row)
    return _masked(draft, table)


def _entered(draft: Draft, table: SolverTable, row: Row) -> SolverTable:
    conf = draft.conf
    if row.name not in conf.lines and row.name not in _MEANT:
        draft.note(row.name, row.fate, row.target, _unsaid(table, row))
        return table
    try:
        change = change_of(table, row, conf.text(row.name), conf.dialect)
        if (reason := _kept(draft, row)) and any(value != effective(table, path) for path, value in change.values.items()):
            draft.note(row.name, Fate.IGNORED, row.target, reason)
            return table
        table = with_values(table, row.name, change.values)
    except ConfError as error:
        draft.note(row.name, Fate.IGNORED, row.target, str(error), alters=True)
        conf.say(row.name, str(error), wrong=True)
        return table
    _enter(draft, row, change)
    return table


def _enter(draft: Draft, row: Row, change: Change) -> None:
    for path, value in change.values.items():
        if row.name in _MEANT or value != effective(_BLANK, path):
            draft.put(("solver", draft.solver_id, *path.split(".")), value, row.name)
    draft.note(row.name, change.fate, row.target, change.note, alters=change.alters)


def _unsaid(table: SolverTable, row: Row) -> str:
    """What happens when the file does not say a key."""
    path = row.target.removeprefix("solver.")
    if row.fate is Fate.IGNORED or not row.target:
        return row.why
    ours: Any = effective(table, path)
    return f"stays {number_text(ours) if isinstance(ours, float) else ours}"


def _kept(draft: Draft, row: Row) -> str:
    """Return why a value of the file is not taken although it could be; empty: it is."""
    conf = draft.conf
    if conf.ours or row.name not in conf.lines:
        return ""
    if row.name in _ACCELERATIONS and conf.choice("pos1-dynamics") == "off":
        return "RTKLIB does not use it with pos1-dynamics=off; ours stays"
    if not row.tuning or row.choices is not None:
        return ""
    value = value_of(row, conf.text(row.name), conf.dialect)
    defaults = [value_of(row, text, conf.dialect) for text in (row.default, row.default_of("2.4"))]
    return "RTKLIB's default, no wish of the file: ours stays, which is measured to be better" if value in defaults else ""


def _masked(draft: Draft, table: SolverTable) -> SolverTable:
    """Enter one C/N0 mask for those of RTKLIB's bands that are used."""
    conf = draft.conf
    switched = [name for name in _MASK_SWITCHES if conf.choice(name) == "on"]
    used = [name for name in _MASKS[: table.frequencies] if ALL_ROWS[name].known_to(conf.dialect)]
    try:
        values = {name: mask_values(ALL_ROWS[name], conf.text(name)) for name in used}
    except ConfError as error:
        conf.say(str(error).partition(":")[0], str(error), wrong=True)
        values, switched = {}, []
    least = min((min(row) for row in values.values()), default=0.0) if switched else 0.0
    uneven = bool(switched) and (len(switched) == 1 or any(value != least for row in values.values() for value in row))
    note = f"one mask of {least:g} dBHz for all elevations and bands, of rover and base" if switched else "off: no mask"
    for name in (*_MASK_SWITCHES, *_MASKS):
        if ALL_ROWS[name].known_to(conf.dialect):
            draft.note(name, Fate.TRANSLATED, "solver.cn0_mask_dbhz", note, alters=uneven)
    if least:
        draft.put(("solver", draft.solver_id, "cn0_mask_dbhz"), least, *used)
    return with_values(table, "pos1-snrmask_L1", {"cn0_mask_dbhz": least})
