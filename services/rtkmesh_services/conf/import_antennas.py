"""The keys ant1- and ant2- and the ANTEX file of a .conf file -> positions and antennas."""

from typing import Final

from rtkmesh_schemas.config import SolverTable
from rtkmesh_services.conf.places import Vector, ecef, llh, moved, on_earth
from rtkmesh_services.conf.report import Draft
from rtkmesh_services.conf.rows import Fate
from rtkmesh_services.conf.solver_setters import with_values

_LONGEST_NAME: Final = 40
_LONGEST_AVERAGE_S: Final = 86400.0


def import_antennas(draft: Draft, table: SolverTable, ingests: list[str]) -> SolverTable:
    """Enter positions and antennas and say what became of their keys."""
    _base(draft, table, draft.id_of("base") in ingests)
    table = _rover(draft, table)
    for number, name in (("1", "rover_antenna"), ("2", "base_antenna")):
        _antenna(draft, f"ant{number}-anttype", name)
    if file := draft.conf.text("file-rcvantfile"):
        draft.put(("solver", draft.solver_id, "antex"), file, "file-rcvantfile")
        draft.note("file-rcvantfile", Fate.TAKEN, "solver.antex", "relative to the folder of the deployment file")
    return table


def given_position(draft: Draft, number: str) -> Vector | None:
    """Return the ECEF position (m) that ``antN-`` says, with its offset; None where there is none."""
    conf = draft.conf
    kind = conf.choice(f"ant{number}-postype")
    a, b, c = (conf.number(f"ant{number}-pos{axis}") for axis in "123")
    if kind not in ("llh", "xyz") or not any((a, b, c)):
        return None
    position = (a, b, c) if kind == "xyz" else ecef(a, b, c)
    offset = tuple(conf.number(f"ant{number}-antdel{axis}") for axis in "enu")
    if not on_earth(position):
        return None
    return moved(position, (offset[0], offset[1], offset[2])) if any(offset) else position


def _base(draft: Draft, table: SolverTable, present: bool) -> None:
    kind, position = draft.conf.choice("ant2-postype"), given_position(draft, "2")
    where = f"ingest.{draft.id_of('base')}"
    if table.mode == "moving-base":
        _say(draft, "2", Fate.IGNORED, "", "a moving base is positioned epoch by epoch, as in RTKLIB")
    elif position is not None and present:
        _enter_base(draft, kind, position)
    elif kind == "single" and present:
        _average(draft, where)
    else:
        said = {"rtcm": "by its stream", "rinexhead": "by the header of its file", "posfile": "by its stream: there are no station files"}
        lost = "" if present else ", where there is an input for it"
        _say(
            draft,
            "2",
            Fate.TAKEN if kind in ("rtcm", "rinexhead") else Fate.TRANSLATED,
            where,
            said.get(kind, "none is said: by its stream") + lost,
        )
    if draft.conf.choice("ant2-postype") != "single":
        draft.note("ant2-maxaveep", Fate.IGNORED, "", "ant2-postype is not single")


def _enter_base(draft: Draft, kind: str, position: Vector) -> None:
    offset = any(draft.conf.number(f"ant2-antdel{axis}") for axis in "enu")
    keys = ("ant2-pos1", "ant2-postype")
    id_ = draft.id_of("base")
    if kind == "xyz":
        draft.put(("ingest", id_, "position_ecef_m"), [round(value, 4) for value in position], *keys)
    else:
        lat_deg, lon_deg, height_m = llh(position)
        given = tuple(draft.conf.number(f"ant2-pos{axis}") for axis in "123")
        exact = list(given) if not offset else [round(lat_deg, 11), round(lon_deg, 11), round(height_m, 5)]
        draft.put(("ingest", id_, "position_llh_deg"), exact, *keys)
    name = "position_ecef_m" if kind == "xyz" else "position_llh_deg"
    _say(draft, "2", Fate.TAKEN, f"ingest.{id_}.{name}", "with the antenna's offset added" if offset else "")
    for axis in "enu":
        draft.note(
            f"ant2-antdel{axis}",
            Fate.TRANSLATED,
            f"ingest.{id_}.{name}",
            "the antenna's place is the given one with the offset" if offset else "none",
        )


def _average(draft: Draft, where: str) -> None:
    epochs = draft.conf.number("ant2-maxaveep")
    seconds = min(max(epochs, 1.0), _LONGEST_AVERAGE_S) if epochs else _LONGEST_AVERAGE_S
    path = ("ingest", draft.id_of("base"), "base_station")
    draft.put((*path, "mode"), "average", "ant2-postype")
    draft.put((*path, "minimum_s"), seconds, "ant2-maxaveep")
    draft.put((*path, "accuracy_m"), 100.0, "ant2-postype")
    _say(draft, "2", Fate.TRANSLATED, f"{where}.base_station", "the base's own fixes are averaged")
    draft.note("ant2-maxaveep", Fate.TRANSLATED, f"{where}.base_station.minimum_s", "epochs, taken for seconds: at other rates change it")


def _say(draft: Draft, number: str, fate: Fate, target: str, note: str) -> None:
    for name in ("postype", "pos1", "pos2", "pos3"):
        draft.note(f"ant{number}-{name}", fate, target, note)
    for axis in "enu":
        lost = number == "1" or fate is not Fate.IGNORED
        value = draft.conf.number(f"ant{number}-antdel{axis}")
        why = "positions are those of the antenna, not of a mark below it"
        draft.note(f"ant{number}-antdel{axis}", Fate.IGNORED, "", why if value else "none", alters=bool(value) and lost)


def _rover(draft: Draft, table: SolverTable) -> SolverTable:
    position = given_position(draft, "1")
    if table.mode != "fixed":
        _say(draft, "1", Fate.IGNORED, "", "of mode fixed alone")
        return table
    if position is None:
        draft.conf.say("pos1-posmode", "pos1-posmode: fixed needs the rover's place in ant1-pos1, -pos2, -pos3", wrong=True)
        draft.put(("solver", draft.solver_id, "mode"), "static", "pos1-posmode")
        _say(draft, "1", Fate.IGNORED, "", "no place is said: mode static instead")
        return with_values(table, "pos1-posmode", {"mode": "static"})
    draft.put(("solver", draft.solver_id, "fixed_position_ecef_m"), [round(value, 4) for value in position], "ant1-pos1")
    _say(draft, "1", Fate.TRANSLATED, "solver.fixed_position_ecef_m", "in ECEF")
    return with_values(table, "ant1-pos1", {"fixed_position_ecef_m": position})


def _antenna(draft: Draft, key: str, name: str) -> None:
    text = draft.conf.text(key)
    if text in ("", "*"):
        draft.note(key, Fate.TAKEN, f"solver.{name}", "what its stream says")
    elif len(text) > _LONGEST_NAME:
        draft.note(key, Fate.IGNORED, f"solver.{name}", f"is longer than {_LONGEST_NAME} letters: no IGS name", alters=True)
    else:
        draft.put(("solver", draft.solver_id, name), text, key)
        draft.note(key, Fate.TAKEN, f"solver.{name}", "`rtkmesh check` says whether the antenna is known")
