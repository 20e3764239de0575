"""The base stations that can be selected: those of the file, those found by hot-plug, and those that users have made.

``PresetBook`` is what everybody asks who lists, changes or selects them (commands, keys, Flockwave). It belongs to control's work loop.
"""

import contextlib
import logging
import secrets
import time
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from rtkmesh_schemas.config_presets import FilterTable, PresetTable
from rtkmesh_schemas.presets import PRESET_NAME, Preset, PresetFile, PresetType, Selection
from rtkmesh_services.control.preset_fields import NO_SUCH, NOT_OURS, PresetError, changed_table, new_table
from rtkmesh_services.control.preset_ports import FoundPort
from rtkmesh_services.runtime.state_files import locked, write_state

USERS_FILE: Final = "presets.json"
SELECTION_FILE: Final = "preset_selection.json"
MAXIMUM_USER_PRESETS: Final = 200
MAXIMUM_FILE: Final = 1 << 22
BACK_S: Final = 30.0  # a port that is back within so long of the user's choice is selected again
_log = logging.getLogger("rtkmesh.control")


class Change(StrEnum):
    """What a listener is told of: ``(change, preset id or "", solver or "")``."""

    PRESETS = "presets"  # one came, went or has become another
    SELECTED = "selected"  # selected, for the fleet ("") or a solver; id "": none
    LOST = "lost"  # the selected one has vanished
    BACK = "back"  # it is back, and selected again


T = TypeVar("T", bound=msgspec.Struct)
Listener = Callable[[Change, str, str], None]


class PresetBook:
    """The presets and which one is selected. ``clock_s`` is monotonic."""

    def __init__(
        self, builtin: Mapping[str, PresetTable], folder: Path | None = None, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        """``folder``: where users' presets and the selection are kept; None: nowhere."""
        self._folder, self._clock_s = folder, clock_s
        self._presets: dict[str, Preset] = {}
        self._listeners: list[Listener] = []
        self._selection = Selection()
        self._chosen_s: dict[str, float] = {}  # when a user chose, for the fleet ("") or a solver
        self._lost: dict[str, str] = {}
        for id_, table in builtin.items():
            self._presets[id_] = preset_of(id_, table, PresetType.BUILTIN)
        self._read_users()
        self._read_selection(builtin)

    # -- the presets

    def ids(self) -> list[str]:
        """Return the ids in the order in which they came."""
        return list(self._presets)

    def get(self, id: str) -> Preset | None:  # noqa: A002  the word of the messages
        """Return a preset, or None."""
        return self._presets.get(id)

    def new(self, fields: Mapping[str, Any], id: str = "") -> str:  # noqa: A002
        """Make a user's preset of ``fields`` (sources, title, format ...); return its id. PresetError says what is wrong with them."""
        table = new_table(fields)
        if sum(preset.type is PresetType.USER for preset in self._presets.values()) >= MAXIMUM_USER_PRESETS:
            raise PresetError(f"there are {MAXIMUM_USER_PRESETS} presets of users already")
        if id and not PRESET_NAME.fullmatch(id):
            raise PresetError(f"{id[:64]!r} is no preset's name: 1 to 64 letters, digits, '_', '-', '.'")
        if id in self._presets:
            raise PresetError(f"there is a preset {id!r} already")
        id = id or self._random_id()  # noqa: A001
        self._put(preset_of(id, table, PresetType.USER))
        return id

    def update(self, id: str, fields: Mapping[str, Any]) -> None:  # noqa: A002
        """Change fields of a user's preset; PresetError says why not."""
        preset = self._users(id)
        self._put(preset_of(id, changed_table(preset.table, fields), PresetType.USER))

    def delete(self, id: str) -> None:  # noqa: A002
        """Forget a user's preset; where it is selected, nothing is from now on."""
        self._users(id)
        self._remove(id, lost=False)

    def save(self) -> None:
        """Keep the users' presets for the next start; PresetError says why that fails."""
        users = {id_: preset.table for id_, preset in self._presets.items() if preset.type is PresetType.USER}
        self._write(USERS_FILE, PresetFile(presets=users))

    def replace_builtin(self, builtin: Mapping[str, PresetTable]) -> None:
        """Take the presets of a file that was read again."""
        for id_, preset in list(self._presets.items()):
            if preset.type is PresetType.BUILTIN and id_ not in builtin:
                self._remove(id_, lost=False)
        for id_, table in builtin.items():
            made = preset_of(id_, table, PresetType.BUILTIN)
            if made != self._presets.get(id_):
                self._put(made)

    def ports(self, found: Mapping[str, FoundPort]) -> None:
        """Take the serial ports that are plugged in, by the ids of their presets."""
        for id_, preset in list(self._presets.items()):
            if preset.type is PresetType.DYNAMIC and id_ not in found:
                self._remove(id_, lost=True)
        for id_, port in found.items():
            if id_ not in self._presets:
                self._put(preset_of(id_, port.table, PresetType.DYNAMIC))
                self._select_again(id_)

    # -- the selection

    def selected(self, solver: str = "") -> str | None:
        """Return the preset that is selected for the fleet, or for one solver (its own, else the fleet's)."""
        if solver and solver in self._selection.solvers:
            return self._selection.solvers[solver]
        return self._selection.fleet

    @property
    def chosen(self) -> bool:
        """Whether somebody has ever chosen for all."""
        return self._selection.made

    def own(self, solver: str) -> bool:
        """Return whether a solver has a selection of its own."""
        return solver in self._selection.solvers

    def select(self, id: str | None, solver: str = "") -> None:  # noqa: A002
        """Select a preset, or none, for the fleet (solvers' own selections end) or for one solver; PresetError where there is none."""
        if id is not None and id not in self._presets:
            raise PresetError(NO_SUCH)
        if id is not None and self._presets[id].format == "rtcm2":
            raise PresetError("RTCM 2 is not decoded here: the base has to send RTCM 3 or UBX")
        self._chosen_s = {**({} if not solver else self._chosen_s), solver: self._clock_s()}
        self._lost = {} if not solver else {name: lost for name, lost in self._lost.items() if name != solver}
        self._set(id, solver)
        self._tell(Change.SELECTED, id or "", solver)

    def follow_fleet(self, solver: str) -> None:
        """End a solver's own selection: the fleet's counts for it again."""
        if solver in self._selection.solvers:
            solvers = {name: id_ for name, id_ in self._selection.solvers.items() if name != solver}
            self._keep(Selection(fleet=self._selection.fleet, solvers=solvers, made=self._selection.made))
            self._tell(Change.SELECTED, self._selection.fleet or "", solver)

    def on_change(self, listener: Listener) -> None:
        """Call ``listener(change, id, solver)`` after each change."""
        self._listeners.append(listener)

    # -- inner

    def _set(self, id_: str | None, solver: str) -> None:
        self._keep(self._with(id_, solver, self._selection.solvers if solver else {}))

    def _with(self, id_: str | None, solver: str, solvers: Mapping[str, str | None]) -> Selection:
        """Return the selection with another one for a solver or for the fleet."""
        if solver:
            return Selection(fleet=self._selection.fleet, solvers={**solvers, solver: id_}, made=self._selection.made)
        return Selection(fleet=id_, solvers=dict(solvers), made=True)

    def _keep(self, selection: Selection) -> None:
        self._selection = selection
        with contextlib.suppress(PresetError):  # logged; it acts all the same
            self._write(SELECTION_FILE, selection)

    def _put(self, preset: Preset) -> None:
        self._presets[preset.id] = preset
        self._tell(Change.PRESETS, preset.id, "")

    def _remove(self, id_: str, *, lost: bool) -> None:
        del self._presets[id_]
        self._tell(Change.PRESETS, id_, "")
        for solver in ("", *self._selection.solvers):
            chosen = self._selection.fleet if not solver else self._selection.solvers.get(solver)
            if chosen == id_:
                self._vanish(id_, solver, lost=lost)

    def _vanish(self, id_: str, solver: str, *, lost: bool) -> None:
        """Select nothing where a preset was that is not there any more; remember a port for the case that it is back soon."""
        if lost:
            self._lost[solver] = id_
        self._keep(self._with(None, solver, self._selection.solvers))
        self._tell(Change.LOST, id_, solver)

    def _select_again(self, id_: str) -> None:
        for solver, lost in list(self._lost.items()):
            if lost != id_:
                continue
            del self._lost[solver]
            if self._clock_s() - self._chosen_s.get(solver, -BACK_S) <= BACK_S:
                self._keep(self._with(id_, solver, self._selection.solvers))
                self._tell(Change.BACK, id_, solver)

    def _users(self, id_: str) -> Preset:
        preset = self._presets.get(id_)
        if preset is None:
            raise PresetError(NO_SUCH)
        if preset.type is not PresetType.USER:
            raise PresetError(NOT_OURS)
        return preset

    def _random_id(self) -> str:
        while (id_ := secrets.token_urlsafe(9)) in self._presets:
            pass
        return id_

    def _tell(self, change: Change, id_: str, solver: str) -> None:
        for listener in self._listeners:
            listener(change, id_, solver)

    # -- what is kept

    def _read_users(self) -> None:
        kept = self._read(USERS_FILE, PresetFile)
        for id_, table in (kept.presets if kept is not None else {}).items():
            if id_ in self._presets:
                _log.warning("a saved preset is named %r as one of the file: that of the file is used", id_)
            elif PRESET_NAME.fullmatch(id_):
                self._presets[id_] = preset_of(id_, table, PresetType.USER)

    def _read_selection(self, builtin: Mapping[str, PresetTable]) -> None:
        kept = self._read(SELECTION_FILE, Selection)
        kept = Selection() if kept is None else kept
        first = kept.fleet if kept.made else next((id_ for id_, table in builtin.items() if table.auto_select), None)
        wanted = {"": first, **kept.solvers}
        there = {solver: id_ if id_ in self._presets else None for solver, id_ in wanted.items()}
        self._selection = Selection(fleet=there.pop(""), solvers=there, made=kept.made)
        for solver, id_ in wanted.items():
            if id_ is not None and id_ not in self._presets:  # a port that is perhaps there in a moment
                self._lost[solver], self._chosen_s[solver] = id_, self._clock_s()

    def _read(self, name: str, type_: type[T]) -> T | None:
        file = None if self._folder is None else self._folder / name
        try:
            if file is None or file.stat().st_size > MAXIMUM_FILE:
                return None
            return msgspec.json.decode(file.read_bytes(), type=type_)
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError) as error:
            _log.warning("%s is not read: %s", file, error)
            return None

    def _write(self, name: str, content: msgspec.Struct) -> None:
        if self._folder is None:
            return
        file = self._folder / name
        try:
            with locked(file):
                write_state(file, msgspec.json.encode(content))
        except OSError as error:
            _log.warning("%s: %s", file, error)
            raise PresetError(f"{file}: {error.strerror or error}") from error


def preset_of(id_: str, table: PresetTable, type_: PresetType) -> Preset:
    """Return the preset of a table."""
    told: FilterTable = table.filter
    return Preset(
        id=id_,
        title=table.title or id_,
        format=table.format,
        sources=table.sources,
        type=type_,
        accept=told.accept,
        reject=told.reject,
        auto_survey=table.auto_survey,
        auto_select=table.auto_select,
        init=table.init,
        standby=table.standby,
        table=table,
    )
