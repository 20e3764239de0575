"""One process of the fleet as the supervisor sees it: its states, and its row in the table."""

import math
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

from rtkmesh_services.control.fleet import ProcessSpec

NEVER: Final = -math.inf


class ProcessState(StrEnum):
    """States of a supervised process."""

    STOPPED = "STOPPED"
    STARTING = "STARTING"  # spawned, no heartbeat yet
    RUNNING = "RUNNING"
    STOPPING = "STOPPING"
    WAITING = "WAITING"  # until its next start: back-off, or for the hub
    FAILED = "FAILED"


class Verb(StrEnum):
    """What the supervisor asks of the operating system."""

    SPAWN = "spawn"
    TERMINATE = "terminate"
    KILL = "kill"


@dataclass(frozen=True, slots=True)
class Action:
    """One thing to do now."""

    verb: Verb
    id: str


@dataclass(slots=True)
class ProcessRecord:
    """Desired and actual state of one process. Times are monotonic seconds."""

    spec: ProcessSpec
    wanted: bool = True
    state: ProcessState = ProcessState.STOPPED
    reason: str = ""
    pid: int = 0
    restarts: int = 0
    start_id: str = ""
    started_s: float = NEVER
    watched_s: float = NEVER  # since when its heartbeats are listened to
    start_at_s: float = NEVER
    stop_asked_s: float = NEVER
    killed: bool = False
    hung: bool = False
    terminated: bool = False
    removed: bool = False
    heartbeat_s: float = NEVER
    deaths_s: deque[float] = field(default_factory=deque[float])

    @property
    def alive(self) -> bool:
        """Whether the operating system has a process for this record."""
        return self.pid != 0


def row_of(record: ProcessRecord, now_s: float) -> dict[str, Any]:
    """Return what the table says of a process, as plain values."""
    return {
        "id": record.spec.id,
        "role": str(record.spec.role),
        "state": str(record.state),
        "wanted": record.wanted,
        "pid": record.pid,
        "start_id": record.start_id,
        "restarts": record.restarts,
        "uptime_s": round(now_s - record.started_s, 3) if record.alive else 0.0,
        "heartbeat_age_s": round(now_s - record.heartbeat_s, 3) if record.alive and record.heartbeat_s > NEVER else None,
        "reason": record.reason,
    }
