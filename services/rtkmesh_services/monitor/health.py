"""How the fleet is, from what it says and how long it has been silent. Pure: times come in.

The limits are not written here: a stream with a nominal rate in ``keys.STREAMS`` is stale after ``STALE_PERIODS`` of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

from rtkmesh_schemas.keys import STALE_PERIODS, STATUS, STREAMS, Kind, Role, Stream
from rtkmesh_schemas.status import ServiceStatus, State

WATCHED: Final = tuple(s for s in STREAMS if s.rate_hz and s.kind in (Kind.PUBLISH, Kind.CACHED))
FORGET_S: Final = 600.0  # a process that went without a word is shown as gone for this long


class Health(StrEnum):
    """What an operator needs to know about a process, worst last."""

    OK = "ok"
    STOPPED = "stopped"
    STARTING = "starting"
    DEGRADED = "degraded"
    STALE = "stale"  # it or one of its streams is silent, its token stands: hung or overloaded
    GONE = "gone"  # silent, and its token is away
    FAILED = "failed"


_OF_STATE: Final = {
    State.STARTING: Health.STARTING,
    State.WARMING: Health.STARTING,
    State.RUNNING: Health.OK,
    State.DEGRADED: Health.DEGRADED,
    State.STALE: Health.STALE,
    State.STOPPED: Health.STOPPED,
    State.FAILED: Health.FAILED,
}
_GOOD: Final = frozenset({Health.OK, Health.STOPPED, Health.STARTING})


@dataclass(frozen=True, slots=True)
class Verdict:
    """The health of one process and why."""

    health: Health
    reason: str = ""

    @property
    def good(self) -> bool:
        """Whether an operator can look elsewhere."""
        return self.health in _GOOD


@dataclass(slots=True)
class _Process:
    role: str
    status: ServiceStatus | None = None
    alive: bool = False
    gone_s: float | None = None
    heard_s: dict[str, float] = field(default_factory=dict[str, float])


class FleetHealth:
    """The newest word of every process and what follows from it."""

    def __init__(self) -> None:
        self._processes: dict[str, _Process] = {}
        self._verdicts: dict[str, Verdict] = {}

    def heard(self, stream: Stream, id: str, now_s: float) -> None:  # noqa: A002  the word of the design
        """Note a message of a watched stream."""
        if process := self._processes.get(id):
            process.heard_s[stream.name] = now_s

    def status(self, status: ServiceStatus, now_s: float) -> None:
        """Note a status."""
        process = self._processes.setdefault(status.id, _Process(status.role))
        if process.status is not None and process.status.start_id != status.start_id:
            process.heard_s.clear()
        process.status, process.role = status, status.role
        process.heard_s[STATUS.name] = now_s

    def live(self, id: str, role: str, now_s: float, *, alive: bool) -> None:  # noqa: A002
        """Note that a liveliness token came or went."""
        process = self._processes.setdefault(id, _Process(role))
        process.alive = alive
        process.gone_s = None if alive else now_s

    def check(self, now_s: float) -> list[tuple[str, Verdict, Verdict]]:
        """Return (id, before, now) of every process whose health has changed, and remember it."""
        for id_ in [id_ for id_, process in self._processes.items() if _forgotten(process, now_s)]:
            del self._processes[id_]
            self._verdicts.pop(id_, None)
        changes: list[tuple[str, Verdict, Verdict]] = []
        for id_, process in self._processes.items():
            before = self._verdicts.get(id_, Verdict(Health.STARTING))
            now = _verdict(process, now_s)
            self._verdicts[id_] = now
            if (before.health, _stable(before)) != (now.health, _stable(now)):
                changes.append((id_, before, now))
        return changes

    def role_of(self, id: str) -> str:  # noqa: A002
        """Return the role of a known process."""
        return self._processes[id].role

    def bad(self) -> dict[str, Verdict]:
        """Return the processes that somebody should look at."""
        return {id_: verdict for id_, verdict in self._verdicts.items() if not verdict.good}

    def table(self, now_s: float) -> dict[str, Mapping[str, Any]]:
        """Return one row per process as plain values."""
        return {id_: _row(process, self._verdicts.get(id_, Verdict(Health.STARTING)), now_s) for id_, process in self._processes.items()}


def stale_after_s(stream: Stream) -> float:
    """Return the silence after which a stream with a nominal rate is stale."""
    assert stream.rate_hz, "only streams with a nominal rate"
    return STALE_PERIODS / stream.rate_hz


def _verdict(process: _Process, now_s: float) -> Verdict:
    status = process.status
    if status is None:
        return Verdict(Health.STARTING) if process.alive else Verdict(Health.GONE, "it left before its first status")
    silent_s = now_s - process.heard_s[STATUS.name]
    if not process.alive and status.state in (State.STARTING, State.WARMING) and silent_s <= stale_after_s(STATUS):
        return Verdict(Health.STARTING)
    if not process.alive and process.gone_s is not None:
        return Verdict(Health.GONE, "its liveliness token is away")
    if silent_s > stale_after_s(STATUS):
        return Verdict(Health.STALE, f"no status for {silent_s:.0f} s: hung")
    quiet = _silent_streams(process, now_s) if status.state is State.RUNNING and not status.data.get("end") else []
    if quiet:
        return Verdict(Health.STALE, f"silent: {', '.join(quiet)}")
    if status.role == Role.MONITOR and status.state is State.DEGRADED:
        return Verdict(Health.OK)  # it says how others are; to repeat that of oneself or of each other would never end
    return Verdict(_OF_STATE[status.state], status.reason)


def _silent_streams(process: _Process, now_s: float) -> list[str]:
    return [s.name for s in WATCHED if s.name in process.heard_s and now_s - process.heard_s[s.name] > stale_after_s(s)]


def _stable(verdict: Verdict) -> str:
    """Return the reason without its figures: a growing age is no change."""
    return "".join(c for c in verdict.reason if not c.isdigit())


def _forgotten(process: _Process, now_s: float) -> bool:
    return process.gone_s is not None and not process.alive and now_s - process.gone_s > FORGET_S


def _row(process: _Process, verdict: Verdict, now_s: float) -> Mapping[str, Any]:
    status = process.status
    return {
        "role": process.role,
        "health": str(verdict.health),
        "reason": verdict.reason,
        "state": "" if status is None else str(status.state),
        "alive": process.alive,
        "age_s": None if status is None else round(now_s - process.heard_s[STATUS.name], 2),
    }
