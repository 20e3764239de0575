"""Processes that an earlier control left running: taken over when they are what is wanted, else ended or replaced.

They are no children of ours: their end is seen by a pidfd, their exit code by nobody.
"""

import contextlib
import os
import select
import signal
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from rtkmesh_schemas.keys import Role
from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.control.output import ProcessLog
from rtkmesh_services.control.registry import ProcessEntry
from rtkmesh_services.control.supervisor import EXIT_UNKNOWN
from rtkmesh_services.runtime.host_processes import Identity, group_members, identity_of, is_alive, send_signal

_POLL_S: Final = 0.02  # without pidfd


class Adopted:
    """A running process of an earlier control, with what the keeper needs of a child."""

    def __init__(self, spec: ProcessSpec, identity: Identity, definition: str = "") -> None:
        """Take it over; ProcessLookupError when it has gone. ``definition``: what it was started as."""
        self.spec, self.identity, self.pid, self.definition = spec, identity, identity.pid, definition
        self._log = ProcessLog(spec)
        self.exit_descriptor: int | None = None
        with contextlib.suppress(OSError):
            self.exit_descriptor = os.pidfd_open(self.pid)
        if not is_alive(identity):  # looked at after the pidfd was opened: now it is of that very process
            self._close()
            raise ProcessLookupError(f"pid {self.pid} has gone")

    def recognised(self, spec: ProcessSpec) -> None:
        """Know what it is of now."""
        self.spec, self._log = spec, ProcessLog(spec)

    def descriptors(self) -> list[int]:
        """Return the descriptor of its exit, where the kernel offers it."""
        return [] if self.exit_descriptor is None else [self.exit_descriptor]

    def read(self, descriptor: int) -> bool:  # noqa: ARG002  as of a child
        """Its output goes to its log file: there is nothing to read."""
        return False

    def signal(self, number: int) -> None:
        """Send a signal to its process group, if it is still there."""
        if is_alive(self.identity):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, number)

    def reap(self) -> int | None:
        """Return EXIT_UNKNOWN if it has ended, and end what it left in its group; else None."""
        if is_alive(self.identity):
            return None
        # A number is not given away while a group has it: without the process, those in its group are what it left.
        if identity_of(self.pid) is None:
            for pid in group_members(self.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        self._close()
        return EXIT_UNKNOWN

    @property
    def last_error(self) -> str:
        """The newest line that says what went wrong."""
        return self._log.last_error()

    def _close(self) -> None:
        if self.exit_descriptor is not None:
            os.close(self.exit_descriptor)
            self.exit_descriptor = None


@dataclass(frozen=True, slots=True)
class Findings:
    """What an earlier control left: running as wanted, running otherwise, wanted no more, and ended while no control was there."""

    kept: dict[str, ProcessEntry] = field(default_factory=dict[str, ProcessEntry])
    changed: dict[str, ProcessEntry] = field(default_factory=dict[str, ProcessEntry])
    removed: dict[str, ProcessEntry] = field(default_factory=dict[str, ProcessEntry])
    ended: dict[str, ProcessEntry] = field(default_factory=dict[str, ProcessEntry])

    @property
    def running(self) -> dict[str, ProcessEntry]:
        """All that run."""
        return self.kept | self.changed | self.removed

    def in_words(self) -> str:
        """Return what was found, empty when it is nothing."""
        parts = (("taken over", self.kept), ("changed", self.changed), ("not wanted", self.removed), ("ended meanwhile", self.ended))
        return "; ".join(f"{what}: {', '.join(ids)}" for what, ids in parts if ids)


def sort_out(entries: Mapping[str, ProcessEntry], alive: Iterable[str], specs: Iterable[ProcessSpec]) -> Findings:
    """Return how what was left compares with what is wanted; ``alive`` are the ids of the entries whose processes are really there."""
    wanted, there, found = {spec.id: spec for spec in specs}, set(alive), Findings()
    for id_, entry in entries.items():
        spec = wanted.get(id_)
        if id_ not in there:
            if entry.identity is not None:
                found.ended[id_] = entry
        elif spec is None:
            found.removed[id_] = entry
        elif spec.definition != entry.definition:
            found.changed[id_] = entry
        else:
            found.kept[id_] = entry
    return found


def end_all(processes: Iterable[Identity], grace_s: float) -> list[Identity]:
    """End processes that are no children of ours: SIGTERM, the grace time, SIGKILL. Return those that are there even then."""
    left = [identity for identity in processes if send_signal(identity, signal.SIGTERM)]
    if left := wait_gone(left, grace_s):
        for identity in left:
            send_signal(identity, signal.SIGKILL)
        left = wait_gone(left, grace_s)
    return left


def wait_gone(processes: Iterable[Identity], timeout_s: float) -> list[Identity]:
    """Wait until processes have ended; return those that have not in time."""
    deadline_s = time.monotonic() + timeout_s
    left = [identity for identity in processes if is_alive(identity)]
    while left and (rest_s := deadline_s - time.monotonic()) > 0.0:
        _wait_for_one(left[0], rest_s)
        left = [identity for identity in left if is_alive(identity)]
    return left


def hubs_last(entries: Iterable[ProcessEntry]) -> tuple[list[Identity], list[Identity]]:
    """Return (all others, the hubs): the order in which a deployment ends."""
    rows = [(entry.role == Role.HUB, entry.identity) for entry in entries if entry.identity is not None]
    return [who for is_hub, who in rows if not is_hub], [who for is_hub, who in rows if is_hub]


def _wait_for_one(identity: Identity, timeout_s: float) -> None:
    try:
        descriptor = os.pidfd_open(identity.pid)
    except OSError:
        time.sleep(min(_POLL_S, timeout_s))
        return
    try:
        if is_alive(identity):
            select.select([descriptor], [], [], timeout_s)
    finally:
        os.close(descriptor)
