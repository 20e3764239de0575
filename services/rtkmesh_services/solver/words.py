"""RTKRCV's words as a solver answers them: typed, and in RTKRCV's texts. What all processes can (status, error, help ...) is not here."""

from collections.abc import Callable, Mapping
from math import degrees
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rtkmesh.rtk.session import Source
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.status import Level
from rtkmesh_services.errors import CommandError
from rtkmesh_services.runtime.logs import clean
from rtkmesh_services.runtime.service import done
from rtkmesh_services.runtime.words import clip
from rtkmesh_services.solver.options import shown
from rtkmesh_services.solver.screens.navigation import navigation_data, navigation_screen
from rtkmesh_services.solver.screens.satellites import (
    SLOTS,
    observations_data,
    observations_screen,
    satellites_data,
    satellites_screen,
)
from rtkmesh_services.solver.screens.solutions import solution_data, solution_form, solutions_screen, whole
from rtkmesh_services.solver.screens.streams import stream_rows, streams_data, streams_screen
from rtkmesh_services.solver.settings import Outcome
from rtkmesh_services.texts.geodesy import geodetic

if TYPE_CHECKING:
    from rtkmesh_services.solver.service import SolverService

OPERATIONS: Final[Mapping[str, str]] = {
    "start": "begin with a fresh filter",
    "stop": "no more solutions; ephemerides are still collected",
    "restart": "begin anew with a fresh filter and the options that wait for it",
    "solution": "count=N coordinates=dms|deg|xyz|enu|pyl time=gpst|utc|jst|tow flags=1|2|3: the newest solutions",
    "satellite": "frequencies=N: the satellites, and what the filter makes of their signals",
    "observ": "frequencies=N: the newest observations of rover and base",
    "navidata": "the newest ephemerides, ionosphere and leap seconds",
    "stream": "inputs, outputs and logs: type, state, bytes, rate, path, message",
    "option": "[PATTERN]: the options; * before those that wait for a restart",
    "set": "NAME VALUE: change an option, by our name or by RTKLIB's; at once where the filter can go on",
    "load": "FILE: take the options of a .toml or RTKLIB's .conf below the configuration folder",
    "save": "[FILE] overwrite=true: write the options into a file that load reads",
    "mode": "[MODE]: tell or change the positioning mode (g kinematic, s static, f fixed, m moving-base, n as configured)",
    "mark": "[NAME] [COMMENT]: an event with time and place, written into the outputs",
}
_MODES: Final = {"g": "kinematic", "k": "kinematic", "s": "static", "f": "fixed", "m": "moving-base", "movingbase": "moving-base"}
_LONGEST: Final = 200  # characters of a mark


class Words:
    """Answers the words that only solvers have."""

    def __init__(self, solver: "SolverService") -> None:
        self._solver = solver
        self._marks = 0
        self._answers: dict[str, Callable[[dict[str, Any]], Reply]] = {
            "start": self._start, "stop": self._stop, "restart": self._restart, "solution": self._solution, "satellite": self._satellite,
            "observ": self._observ, "navidata": self._navidata, "stream": self._stream, "option": self._option, "set": self._set,
            "load": self._load, "save": self._save, "mode": self._mode, "mark": self._mark,
        }  # fmt: skip

    def answer(self, request: Request) -> Reply:
        """Answer one of OPERATIONS; CommandError says why not."""
        return self._answers[request.op](request.args)

    def _start(self, args: dict[str, Any]) -> Reply:  # noqa: ARG002  the words share one form
        if self._solver.running:
            raise CommandError(Code.WRONG_STATE, "rtk server start error (server already started)")
        self._begin("started", "rtk server start error")
        return done("rtk server start")

    def _restart(self, args: dict[str, Any]) -> Reply:  # noqa: ARG002
        stopped = "stop rtk server\n" if self._solver.running else ""
        self._begin("restarted", "rtk server restart error")
        return told(done("rtk server restart"), f"{stopped}rtk server restart\n")

    def _begin(self, word: str, failure: str) -> None:
        try:
            self._solver.begin(word)
        except ConfigError as error:
            raise CommandError(Code.FAILED, f"{failure} ({error})") from error

    def _stop(self, args: dict[str, Any]) -> Reply:  # noqa: ARG002
        if not self._solver.running:
            raise CommandError(Code.WRONG_STATE, "rtk server already stopped")
        self._solver.stop()
        return told(done("rtk server stop"), "stop rtk server\nrtk server stop\n")

    def _solution(self, args: dict[str, Any]) -> Reply:
        form = solution_form(args)
        solutions = self._solver.recent.newest(form.count)
        data = [solution_data(solution) for solution in solutions]
        return told(done(f"{len(data)} solutions", solutions=data), solutions_screen(solutions, form))

    def _satellite(self, args: dict[str, Any]) -> Reply:
        solution, overview = self._solver.recent.solution, self._solver.session.engine.overview()
        data = satellites_data(solution, overview, self._solver.context.id)
        return told(done(f"{len(data['satellite'])} satellites", **data), self.screen("satellite", self._slots(args)))

    def _observ(self, args: dict[str, Any]) -> Reply:
        epochs = self._solver.recent.epochs
        data = {source.value: observations_data(epoch) for source, epoch in epochs.items()}
        return told(done(f"epochs of {', '.join(data) or 'nobody'}", **data), self.screen("observ", self._slots(args)))

    def _navidata(self, args: dict[str, Any]) -> Reply:  # noqa: ARG002
        session, solution = self._solver.session, self._solver.recent.solution
        now = None if solution is None else solution.time
        data = navigation_data(*session.table.newest(), now, session.klobuchar)
        return told(done(f"{len(data['ephemerides'])} ephemerides", **data), self.screen("navidata"))

    def _stream(self, args: dict[str, Any]) -> Reply:  # noqa: ARG002
        rows = self._streams()
        return told(done(f"{len(rows)} streams", streams=streams_data(rows)), streams_screen(rows))

    def screen(self, word: str, slots: int = 0) -> str:
        """Return what RTKRCV's console shows for a word that is shown again and again, with so many frequencies (0: as configured)."""
        solver, slots = self._solver, slots or self._slots({})
        session, solution = solver.session, solver.recent.solution
        if word == "satellite":
            holds = solver.settings.active.ambiguity.mode == "fix-and-hold"
            return satellites_screen(solution, session.engine.overview(), slots, holds=holds)
        if word == "observ":
            numbers = {Source.ROVER: 1, Source.BASE: 2}
            return observations_screen({numbers[source]: epoch for source, epoch in solver.recent.epochs.items()}, slots)
        if word == "navidata":
            now = None if solution is None else solution.time
            return navigation_screen(*session.table.newest(), now, session.klobuchar)
        return streams_screen(self._streams())

    def _slots(self, args: dict[str, Any]) -> int:
        """Return how many frequencies a screen shows: as asked for (also as RTKRCV's ``-n``), else two, or as many as are used."""
        asked = whole(args, "frequencies", 0, len(SLOTS))
        return asked or max(2, min(self._solver.settings.active.frequencies, len(SLOTS)))

    def _streams(self) -> list[Any]:
        solver = self._solver
        return stream_rows(solver.settings.active, solver.context.deployment, solver.neighbours)

    def _option(self, args: dict[str, Any]) -> Reply:
        options = self._solver.settings.told(str(args.get("pattern") or args.get("key") or "")[:100])
        lines = [
            f"{'*' if 'pending' in option else ' '}{name:<32s} ={shown(option.get('pending', option['value']))}\n"
            for name, option in options.items()
        ]
        return told(done(f"{len(options)} options", options=options), "".join(lines))

    def _set(self, args: dict[str, Any]) -> Reply:
        name = str(args.get("name") or args.get("key") or "")
        if not name:
            raise CommandError(Code.BAD_ARGUMENTS, "specify option type: set NAME VALUE")
        try:
            outcome = self._solver.settings.set(name, args.get("value"), args.get("dialect", "demo5"))
        except ConfigError as error:
            raise CommandError(Code.BAD_ARGUMENTS, f"invalid option value: {clip(name)} ({error.message})") from error
        self._tell(outcome)
        return done(f"option {name} changed.{'' if outcome.at_once else ' restart to enable it'}", name=name, **outcome.data())

    def _tell(self, outcome: Outcome) -> None:
        """Say what options have become: an event for everybody."""
        text = ", ".join(f"{name} {shown(old) or 'default'} -> {shown(new) or 'default'}" for name, (old, new) in outcome.changes.items())
        when = "at once" if outcome.at_once else f"on restart: {outcome.continuation.obstacle}"
        self._solver.context.event(Level.INFO, "options_changed", f"{text or 'no option changed'} ({when})", **outcome.data())

    def _load(self, args: dict[str, Any]) -> Reply:
        file = str(args.get("file", ""))
        if not file:
            raise CommandError(Code.BAD_ARGUMENTS, "no options file: load FILE")
        try:
            outcome = self._solver.settings.load(file, self._solver.context.config_folder)
        except ConfigError as error:
            raise CommandError(Code.BAD_ARGUMENTS, str(error)) from error
        self._tell(outcome)
        self._solver.context.event(Level.INFO, "loaded", f"options of {file} taken")
        rest = "" if outcome.at_once else ". Restart to enable them"
        reply = done(f"Options loaded{rest}", file=file, mode=self._solver.settings.pending.mode, **outcome.data())
        return told(reply, f"options loaded from {file}{rest.lower()}\n")

    def _save(self, args: dict[str, Any]) -> Reply:
        file = str(args.get("file") or f"{self._solver.context.id}_options.toml")
        overwrite = str(args.get("overwrite", "false")).lower() in ("true", "1", "yes")
        try:
            count = self._solver.settings.save(file, self._solver.context.config_folder, overwrite=overwrite)
        except ConfigError as error:
            raise CommandError(Code.BAD_ARGUMENTS, f"options file save error: {error}") from error
        self._solver.context.event(Level.INFO, "saved", f"options saved to {file}")
        return done(f"options saved to {file}", file=file, bytes=count)

    def _mode(self, args: dict[str, Any]) -> Reply:
        asked, settings = str(args.get("mode", "")), self._solver.settings
        if not asked:
            return done(f"positioning mode is {settings.active.mode}", mode=settings.active.mode, pending=settings.pending.mode)
        mode = settings.configured.mode if asked == "n" else _MODES.get(asked, asked)
        return self._set({"name": "mode", "value": mode})

    def _mark(self, args: dict[str, Any]) -> Reply:
        solution = self._solver.recent.solution
        if not self._solver.running or solution is None or solution.status is Status.NONE:
            raise CommandError(Code.WRONG_STATE, "no solution yet: there is no place to mark")
        self._marks += 1
        name = _one_line(args.get("name") or f"mark{self._marks}")
        data = mark_data(name, _one_line(args.get("comment") or ""), solution)
        self._solver.context.event(Level.INFO, "mark", f"mark {name}: {data['comment']}".rstrip(": "), **data)
        return done(f"mark {name}", **data)


def told(reply: Reply, text: str) -> Reply:
    """Return a reply with what RTKRCV's console shows."""
    return msgspec.structs.replace(reply, text=text)


def _one_line(text: Any) -> str:
    return clean(" ".join(str(text).split()))[:_LONGEST]


def mark_data(name: str, comment: str, solution: Solution) -> dict[str, Any]:
    """Return the data of the event ``mark``."""
    x, y, z = solution.position_ecef_m.tolist()
    lat_rad, lon_rad, height_m = geodetic((x, y, z))
    return {
        "name": name,
        "comment": comment,
        "week": solution.time.week,
        "tow_s": solution.time.tow_s,
        "status": int(solution.status),
        "position_ecef_m": [x, y, z],
        "lat_deg": degrees(lat_rad),
        "lon_deg": degrees(lon_rad),
        "height_m": height_m,
    }
