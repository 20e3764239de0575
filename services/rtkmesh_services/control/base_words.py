"""The commands to base presets: list, show, select, follow, new, update, delete, save; of ``rtk/control/cmd`` and of each preset's key."""

from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.presets import Preset, ingest_id
from rtkmesh_services.control.preset_fields import NO_SUCH, NOT_OURS, PresetError
from rtkmesh_services.control.presets import PresetBook
from rtkmesh_services.errors import CommandError
from rtkmesh_services.ntrip.address import shown_url
from rtkmesh_services.runtime.service import accepted, done
from rtkmesh_services.runtime.words import clip, nearest

HELP: Final = (
    "action=list|show|select|follow|new|update|delete|save [id=PRESET] [solver=SOLVER] [fields] [first=0]: base stations; "
    "select without id: none; follow: what is selected for all counts for this solver too"
)
TOLD: Final = 60  # presets in one answer: it has to fit into a message
_FLEET: Final = frozenset({"", "all", "*"})


class Teller(Protocol):
    """Who knows how presets are."""

    def state_of(self, preset: Preset) -> Mapping[str, Any]:
        """Return state, score and users of a preset as plain values."""
        ...

    def solvers(self) -> list[str]:
        """Return the solvers that have a base station."""
        ...


class PresetDesk:
    """Does the commands. All in control's work loop."""

    def __init__(self, book: PresetBook, teller: Teller) -> None:
        self._book, self._teller = book, teller
        self._actions: dict[str, Callable[[Mapping[str, Any]], Reply]] = {
            "list": self._list,
            "show": self._show,
            "select": self._select,
            "follow": self._follow,
            "new": self._new,
            "update": self._update,
            "delete": self._delete,
            "save": self._save,
        }

    def command(self, request: Request) -> Reply:
        """Do a command to ``rtk/control/cmd``; CommandError says why not."""
        return self.act(str(request.args.get("action", "list")), request.args)

    def act(self, action: str, arguments: Mapping[str, Any]) -> Reply:
        """Do one action; CommandError says why not."""
        if action not in self._actions:
            known = list(self._actions)
            hint = nearest(action, known) or f"; there are {', '.join(known)}"
            raise CommandError(Code.BAD_ARGUMENTS, f"no action {clip(action)!r}{hint}")
        try:
            return self._actions[action](arguments)
        except PresetError as error:
            raise CommandError(_code(error), self._with_hint(str(error), arguments)) from error

    def describe(self, preset: Preset) -> dict[str, Any]:
        """Return a preset as plain values, without passwords."""
        return {
            "id": preset.id,
            "title": preset.title,
            "type": str(preset.type),
            "format": preset.format,
            "sources": [shown_url(source) for source in preset.sources],
            "accept": list(preset.accept),
            "reject": list(preset.reject),
            "auto_survey": preset.auto_survey,
            "auto_select": preset.auto_select,
            "standby": preset.standby,
            "ingest": ingest_id(preset.id),
            **self._teller.state_of(preset),
        }

    def _list(self, arguments: Mapping[str, Any]) -> Reply:
        ids, first = self._book.ids(), _whole(arguments.get("first", 0))
        presets = [preset for name in ids[first : first + TOLD] if (preset := self._book.get(name)) is not None]
        told = [self.describe(preset) for preset in presets]
        more = {"next": first + TOLD} if first + TOLD < len(ids) else {}
        return done(f"{len(ids)} presets", selected=self._book.selected(), solvers=self._selections(), presets=told, **more)

    def _selections(self) -> dict[str, str | None]:
        return {solver: self._book.selected(solver) for solver in self._teller.solvers() if self._book.own(solver)}

    def _show(self, arguments: Mapping[str, Any]) -> Reply:
        preset = self._book.get(_name(arguments))
        if preset is None:
            raise PresetError(NO_SUCH)
        return done(preset.title, preset=self.describe(preset))

    def _select(self, arguments: Mapping[str, Any]) -> Reply:
        solver, name = self._solver(arguments), _name(arguments) or None
        self._book.select(name, solver)
        for_whom = solver or "all solvers"
        return accepted(f"{name or 'no preset'} is selected for {for_whom}", selected=name, solver=solver)

    def _follow(self, arguments: Mapping[str, Any]) -> Reply:
        solver = self._solver(arguments)
        if not solver:
            raise CommandError(Code.BAD_ARGUMENTS, "say which solver: solver=SOLVER")
        self._book.follow_fleet(solver)
        return accepted(
            f"{solver} follows the selection for all: {self._book.selected(solver) or 'none'}", selected=self._book.selected(solver)
        )

    def _new(self, arguments: Mapping[str, Any]) -> Reply:
        name = self._book.new(_fields(arguments), _name(arguments))
        return done(f"preset {name} is made, not saved yet", id=name)

    def _update(self, arguments: Mapping[str, Any]) -> Reply:
        self._book.update(_name(arguments), _fields(arguments))
        return done(f"preset {_name(arguments)} is changed, not saved yet", id=_name(arguments))

    def _delete(self, arguments: Mapping[str, Any]) -> Reply:
        self._book.delete(_name(arguments))
        return done(f"preset {_name(arguments)} is gone, not saved yet", id=_name(arguments))

    def _save(self, arguments: Mapping[str, Any]) -> Reply:
        del arguments
        self._book.save()
        return done("the presets of users are saved")

    def _solver(self, arguments: Mapping[str, Any]) -> str:
        solver, known = str(arguments.get("solver", "")), self._teller.solvers()
        if solver in _FLEET:
            return ""
        if solver not in known:
            hint = nearest(solver, known) or f"; there are {', '.join(known) or 'none'}"
            raise CommandError(Code.NOT_FOUND, f"no solver {clip(solver)!r} with a base station{hint}")
        return solver

    def _with_hint(self, text: str, arguments: Mapping[str, Any]) -> str:
        if text != NO_SUCH:
            return text
        hint = nearest(_name(arguments), self._book.ids()) or f"; there are {', '.join(self._book.ids()[:20]) or 'none'}"
        return f"{text} {clip(_name(arguments))!r}{hint}"


def _whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise CommandError(Code.BAD_ARGUMENTS, "first is the number of a preset, from 0 on")
    return value


def _name(arguments: Mapping[str, Any]) -> str:
    return str(arguments.get("id") or arguments.get("name") or "")


def _fields(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a preset: those in ``fields``, else all arguments that do not say which preset."""
    told: Any = arguments.get("fields")
    if isinstance(told, Mapping):
        return {str(name): value for name, value in told.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any plain data
    return {name: value for name, value in arguments.items() if name not in ("action", "id", "name", "solver")}


def _code(error: PresetError) -> Code:
    return {NO_SUCH: Code.NOT_FOUND, NOT_OURS: Code.NOT_ALLOWED}.get(str(error), Code.BAD_ARGUMENTS)
