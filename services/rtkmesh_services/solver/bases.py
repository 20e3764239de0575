"""Another base for a solver that runs: listened to first, taken when that costs no epoch, and what it does to the position is told."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

import msgspec

from rtkmesh.rtk.base_change import Candidate, Jump
from rtkmesh.rtk.session import Session, SessionOptions, Source
from rtkmesh.rtk.solution import Solution
from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.config import IngestTable, SolverTable
from rtkmesh_schemas.errors import BadKeyError
from rtkmesh_schemas.keys import check_id
from rtkmesh_schemas.status import InputStatus, Level
from rtkmesh_services.errors import CommandError
from rtkmesh_services.mapping.position import known_position
from rtkmesh_services.runtime.bus import Handle, Sample
from rtkmesh_services.runtime.service import Context, accepted, done
from rtkmesh_services.solver.inputs import STREAMS, InputStream

OPERATIONS: Final[Mapping[str, str]] = {
    "base": "id=INGEST [antenna=NAME] [timeout_s=15]: use another base as soon as it delivers, the rover's state goes on",
}
TIMEOUT_S: Final = 15.0
SILENT_S: Final = 2.5  # a base that is silent for so long is left for the first epoch of another one


class Subscriptions:
    """What a solver subscribes to: the streams of ingests, which may come and go."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._handles: dict[str, list[Handle]] = {}

    def open(self, name: str) -> None:
        """Subscribe to the streams of an ingest, what is cached first."""
        for stream in STREAMS:
            fields = {"satellite": "*"} if "{satellite}" in stream.template else {}
            handle = self._context.subscribe(stream.key(name, **fields), lane=f"in:{name}", history=stream.cache > 0)
            self._handles.setdefault(name, []).append(handle)

    def close(self, name: str) -> None:
        """Subscribe to them no more."""
        for handle in self._handles.pop(name, []):
            handle.close()


@dataclass(slots=True)
class Wiring:
    """What of a solver a change of its base needs. ``table`` and ``take`` read and replace its options."""

    context: Context
    session: Session
    inputs: dict[str, InputStream]
    subscriptions: Subscriptions
    table: Callable[[], SolverTable]
    take: Callable[[SolverTable], None]
    options_of: Callable[[SolverTable], SessionOptions]


@dataclass(slots=True)
class Next:
    """The base that is listened to. ``before``: its stream if it was an input already."""

    table: SolverTable
    stream: InputStream
    candidate: Candidate
    asked_s: float
    timeout_s: float
    before: InputStream | None = None


@dataclass(slots=True)
class Told:
    """A change that was made, until all has been said of it."""

    old: str
    new: str
    announced: bool = False
    warned: bool = False


class BaseChanger:
    """Changes the base of one solver. All in the work loop."""

    def __init__(self, wiring: Wiring) -> None:
        self._wiring, self._context, self._session = wiring, wiring.context, wiring.session
        self._next: Next | None = None
        self._told: Told | None = None
        self._old_ecef_m: list[float] | None = None

    def command(self, request: Request, now_s: float) -> Reply:
        """Begin a change: ``id`` of an ingest, nothing for none; CommandError says why not."""
        name, antenna = str(request.args.get("id", "")), str(request.args.get("antenna", ""))[:40]
        timeout_s = _seconds(request.args.get("timeout_s", TIMEOUT_S))
        table = self._wiring.table()
        self._check(name, table)
        if name == table.base:
            self._give_up()
            return done(f"the base is {name or 'none'} already", base=name)
        changed = msgspec.structs.replace(table, base=name, base_antenna=antenna or self._antenna(name))
        if antenna:
            Session(self._wiring.options_of(changed))  # refuses an unknown antenna
        self._give_up()
        if not name:
            self._switch(changed, None, None)
            return done("no base", base="")
        self._listen(name, changed, timeout_s, now_s)
        return accepted(f"listening to {name}; it is used when it delivers", base=table.base, next=name)

    def takes(self, name: str, sample: Sample, now_s: float) -> bool:
        """Take a sample of the next base; False when it is of another stream."""
        coming = self._next
        if coming is None or coming.stream.name != name:
            return False
        for arrival in coming.stream.take(sample, now_s):
            self._feed(coming, arrival.message, now_s)
        return True

    def advance(self, now_s: float) -> None:
        """Change over when that costs nothing; give up when nothing comes."""
        coming = self._next
        if coming is None:
            return
        for arrival in coming.stream.overdue(now_s):
            self._feed(coming, arrival.message, now_s)
        if self._may_change(coming, now_s):
            self._next = None
            self._switch(coming.table, coming.stream, coming.candidate)
        elif now_s - coming.asked_s > coming.timeout_s:
            self._time_out(coming)

    def solved(self, solution: Solution) -> None:
        """Say what a change has done to the position, with the first solutions after it."""
        jump = self._session.take_jump()
        if (told := self._told) is None:
            self._old_ecef_m = _finite(solution.base_ecef_m.tolist()) or self._old_ecef_m
            return
        if not told.announced:
            told.announced = True
            self._announce(told, jump, solution)
        if jump is not None and jump.significant and not told.warned:
            told.warned = True
            self._warn(told, jump)
        if jump is None or jump.decided:
            self._told = None

    def owner_left(self, name: str) -> None:
        """No process of this id is alive any more."""
        if self._next is not None and self._next.stream.name == name:
            self._next.stream.owner_left()

    def statuses(self, now_s: float) -> list[InputStatus]:
        """Return how the next base's stream is."""
        return [] if self._next is None else [self._next.stream.status(now_s)]

    def data(self, now_s: float) -> dict[str, Any]:
        """Return what a status tells of a change."""
        coming = self._next
        return {} if coming is None else {"next_base": coming.stream.name, "next_base_for_s": round(now_s - coming.asked_s, 1)}

    def _check(self, name: str, table: SolverTable) -> None:
        if table.mode == "single":
            raise CommandError(Code.NOT_ALLOWED, "mode single has no base")
        if self._session.options.pairing.replay or ingest_of(self._context, name).replay:
            raise CommandError(Code.NOT_ALLOWED, "recordings are paired by their own clock: a base is changed among live ones")
        if name == table.rover:
            raise CommandError(Code.BAD_ARGUMENTS, f"{name} is the rover")
        try:
            _ = name and check_id(name)
        except BadKeyError as error:
            raise CommandError(Code.BAD_ARGUMENTS, str(error)) from error
        if name == "*":
            raise CommandError(Code.BAD_ARGUMENTS, "id=INGEST: one base")

    def _antenna(self, name: str) -> str:
        """Return the antenna that the file says for its own base."""
        table = self._context.deployment.solver[self._context.id]
        return table.base_antenna if name == table.base else ""

    def _listen(self, name: str, table: SolverTable, timeout_s: float, now_s: float) -> None:
        before = self._wiring.inputs.pop(name, None)
        stream = before or InputStream(name, Source.BASE, replay=False)
        candidate = Candidate(known_position(ingest_of(self._context, name)))
        self._next = Next(table, stream, candidate, now_s, timeout_s, before)
        self._wiring.subscriptions.close(name)  # again, so that what is cached comes for the candidate too
        self._wiring.subscriptions.open(name)

    def _feed(self, coming: Next, message: Any, now_s: float) -> None:
        if not coming.candidate.take(message, now_s):
            self._session.feed(Source.NAVIGATION, message, now_s)

    def _may_change(self, coming: Next, now_s: float) -> bool:
        pairing, table = self._session.pairing, self._wiring.table()
        if coming.candidate.position_ecef_m is None and table.mode != "moving-base":
            return False
        urgent = not table.base or now_s - pairing.base_arrived_s > SILENT_S
        return coming.candidate.serves(pairing.waiting_for(), table.sync.tolerance_s, urgent=urgent)

    def _switch(self, table: SolverTable, stream: InputStream | None, candidate: Candidate | None) -> None:
        old, inputs = self._wiring.table(), self._wiring.inputs
        table = msgspec.structs.replace(old, base=table.base, base_antenna=table.base_antenna)  # other options may have changed meanwhile
        self._session.change_base(self._wiring.options_of(table), candidate)
        self._leave(old)
        if stream is not None:
            stream.source = Source.BASE
            inputs[stream.name] = stream
        self._wiring.take(table)
        self._told = Told(old.base, table.base)

    def _leave(self, old: SolverTable) -> None:
        """Let go of the old base, unless its ephemerides are wanted."""
        stream = self._wiring.inputs.get(old.base)
        if stream is None:
            return
        if old.base in old.navigation:
            stream.source = Source.NAVIGATION
        else:
            del self._wiring.inputs[old.base]
            self._wiring.subscriptions.close(old.base)

    def _give_up(self) -> None:
        """Listen to the next base no more."""
        coming, self._next = self._next, None
        if coming is None:
            return
        if coming.before is not None:
            self._wiring.inputs[coming.stream.name] = coming.before
        else:
            self._wiring.subscriptions.close(coming.stream.name)

    def _time_out(self, coming: Next) -> None:
        self._give_up()
        name, kept = coming.stream.name, self._wiring.table().base
        why = (
            "its position is not known (no RTCM 1005/1006, none configured)" if coming.candidate.epochs else "no observations come from it"
        )
        text = f"{name} is not used as base, {why} for {coming.timeout_s:g} s; {f'{kept} stays' if kept else 'there is none'}"
        self._context.event(Level.WARNING, "base_not_changed", text, old=kept, new=name)

    def _announce(self, told: Told, jump: Jump | None, solution: Solution) -> None:
        same = self._session.same_antenna and bool(told.new)
        new_ecef_m = _finite(solution.base_ecef_m.tolist())
        data = {"old": told.old, "new": told.new, "old_position_ecef_m": self._old_ecef_m, "new_position_ecef_m": new_ecef_m}
        said = _jump_data(jump)
        how = ", the same antenna: its ambiguities go on" if same else _words(jump)
        self._context.event(
            Level.INFO, "base_changed", f"base {told.old or 'none'} -> {told.new or 'none'}{how}", **data, **said, same_antenna=same
        )
        self._old_ecef_m = new_ecef_m

    def _warn(self, told: Told, jump: Jump) -> None:
        text = f"base {told.old} -> {told.new}{_words(jump)}: more than their sigmas allow; the position of one of the bases is wrong"
        self._context.event(Level.WARNING, "base_jump", text, old=told.old, new=told.new, **_jump_data(jump))


def ingest_of(context: Context, name: str) -> IngestTable:
    """Return the table of an ingest; that of one that is not of the file says nothing."""
    return context.deployment.ingest.get(name, IngestTable(source=""))


def _seconds(value: Any) -> float:
    try:
        seconds = float(value)
    except (TypeError, ValueError):
        seconds = -1.0
    if not 0.1 <= seconds <= 600.0:
        raise CommandError(Code.BAD_ARGUMENTS, "timeout_s is a number of seconds from 0.1 to 600")
    return seconds


def _finite(values: list[float]) -> list[float] | None:
    return values if all(map(isfinite, values)) else None


def _words(jump: Jump | None) -> str:
    if jump is None or not isfinite(jump.enu_m[0]):
        return ""
    east, north, up = jump.enu_m
    return f", the position jumps by {east:+.3f} E {north:+.3f} N {up:+.3f} U m"


def _jump_data(jump: Jump | None) -> dict[str, Any]:
    if jump is None:
        return {"jump_enu_m": None}
    return {
        "jump_enu_m": _finite(list(jump.enu_m)),
        "sigma_enu_m": _finite(list(jump.sigma_enu_m)),
        "old_solution": jump.old_status.name,
        "new_solution": jump.new_status.name,
        "age_s": jump.age_s if isfinite(jump.age_s) else None,
        "significant": jump.significant,
    }
