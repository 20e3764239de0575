"""What to do with each process, decided from the time, the exits and the heartbeats.

Pure: no clock, no process, no thread. All transitions of a process's state live here; ``keeper`` carries the actions out.
"""

from typing import Any, Final

from rtkmesh_schemas.config import ControlTable
from rtkmesh_schemas.keys import Role
from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.control.records import NEVER, Action, ProcessRecord, ProcessState, Verb, row_of

EXIT_UNKNOWN: Final = 256  # above all exit codes: of a process that was no child of ours
EXIT_CONFIG: Final = 2  # a process that cannot use its configuration: starting it again changes nothing
FIRST_HEARTBEAT_S: Final = 30.0  # imports on a loaded small computer, before the first status
STAND_S: Final = 1.5  # the keeper asks for actions twice a second: after a longer pause it, or the machine, stood still
LINK_GAP_S: Final = 2.5  # the bus is trusted while its reference beats at least this often (nominal: 1 s)


class Supervisor:
    """One-for-one supervision with restart intensity, back-off and a watch over the heartbeats of the work loops."""

    def __init__(self, limits: ControlTable) -> None:
        self._limits = limits
        self._records: dict[str, ProcessRecord] = {}
        self._open = False
        self._held: frozenset[Role] = frozenset()
        self._ending = False
        self._reference_s = self._asked_s = NEVER
        self._linked_since_s = NEVER

    # -- desired state

    def add(self, spec: ProcessSpec, *, wanted: bool = True, restarts: int = 0, reason: str = "") -> None:
        """Take a process into the fleet; it is started by the next actions, if it is wanted."""
        state = ProcessState.WAITING if wanted else ProcessState.STOPPED
        self._records[spec.id] = ProcessRecord(spec, wanted=wanted, state=state, restarts=restarts, reason=reason)

    def adopt(self, id: str, pid: int, start_id: str, started_s: float, now_s: float) -> None:  # noqa: A002  the word of the design
        """Note that a process of the fleet runs already, started at ``started_s``: its next heartbeat makes it RUNNING."""
        record = self._records[id]
        heard_s = now_s if start_id else NEVER  # one that was never heard may still be starting
        record.start_id, record.pid = start_id, pid
        record.started_s, record.watched_s, record.heartbeat_s = started_s, now_s, heard_s
        record.state, record.reason = ProcessState.STARTING, "taken over, not heard yet"

    def replace(self, spec: ProcessSpec, now_s: float) -> None:
        """Give a process a new definition and restart it if it is wanted."""
        record = self._records[spec.id]
        record.spec = spec
        if record.wanted:
            self.restart(spec.id, now_s)

    def recognise(self, spec: ProcessSpec) -> None:
        """Know the definition of a process that runs as it says."""
        self._records[spec.id].spec = spec

    def include(self, spec: ProcessSpec, now_s: float) -> None:
        """Take a process into the fleet, also one that is about to be forgotten; another definition restarts it."""
        record = self._records.get(spec.id)
        if record is None:
            self.add(spec)
        elif record.removed or record.spec != spec:
            record.removed, record.spec = False, spec
            self.restart(spec.id, now_s)

    def remove(self, id: str, now_s: float) -> None:  # noqa: A002  the word of the design
        """Stop a process and forget it as soon as it is gone."""
        record = self._records[id]
        self.stop(id, now_s, "removed from the deployment")
        if record.alive:
            record.removed = True
        else:
            del self._records[id]

    def start(self, id: str, now_s: float) -> None:  # noqa: A002
        """Want a process. A FAILED one gets a fresh count of deaths."""
        record = self._records[id]
        record.wanted = True
        if record.state in (ProcessState.STOPPED, ProcessState.FAILED, ProcessState.WAITING):
            record.deaths_s.clear()
            _wait(record, now_s, "")

    def stop(self, id: str, now_s: float, reason: str = "stopped by command") -> None:  # noqa: A002
        """Want a process no more: SIGTERM, the grace time, SIGKILL."""
        record = self._records[id]
        record.wanted = False
        if record.alive:
            _ask_to_stop(record, now_s, reason)
        else:
            record.state, record.reason = ProcessState.STOPPED, reason

    def restart(self, id: str, now_s: float, reason: str = "restart by command") -> None:  # noqa: A002
        """Stop a process if it runs, then start it."""
        record = self._records[id]
        record.wanted = True
        if record.alive:
            _ask_to_stop(record, now_s, reason)
        else:
            self.start(id, now_s)

    def end(self, now_s: float) -> None:
        """Stop all: first the processes, then, when they are gone, the hubs."""
        self._ending = True
        for record in self._records.values():
            record.wanted = False
            if not record.alive:
                record.state = ProcessState.STOPPED
            elif record.spec.role is not Role.HUB:
                _ask_to_stop(record, now_s, "the deployment ends")

    @property
    def ended(self) -> bool:
        """Whether nothing is left after ``end``."""
        return self._ending and not any(record.alive for record in self._records.values())

    # -- what happened

    def hub_ready(self) -> None:
        """Let the other processes start: the hub takes connections (or there is none of ours)."""
        self._open = True

    def hold(self, roles: frozenset[Role]) -> None:
        """Let the processes of these roles wait with their start, and no others."""
        self._held = roles

    def spawned(self, id: str, pid: int, now_s: float) -> None:  # noqa: A002
        """Note the start of a process. One that is not wanted any more by now is stopped at once."""
        record = self._records[id]
        record.pid, record.started_s, record.watched_s, record.heartbeat_s = pid, now_s, now_s, NEVER
        record.state, record.reason, record.start_id = ProcessState.STARTING, "", ""
        record.killed = record.hung = record.terminated = False
        if not record.wanted:
            _ask_to_stop(record, now_s, "stopped while it was started")

    def not_spawned(self, id: str, why: str, now_s: float) -> None:  # noqa: A002
        """Note that a process could not be started."""
        self._died(self._records[id], f"cannot be started: {why}", now_s)

    def exited(self, id: str, code: int, last_line: str, now_s: float) -> None:  # noqa: A002
        """Note the end of a process. ``code`` as of subprocess: negative is a signal; or EXIT_UNKNOWN."""
        record = self._records.get(id)
        if record is None:
            return
        record.pid = 0
        if record.removed:
            del self._records[id]
        elif record.hung:
            self._died(record, record.reason, now_s)
        elif record.state is ProcessState.STOPPING:
            self._stopped(record, now_s)
        else:
            self._died(record, _cause(code, last_line), now_s, permanent=code == EXIT_CONFIG)

    def heartbeat(self, id: str, pid: int, now_s: float, start_id: str = "") -> None:  # noqa: A002
        """Note a status from a work loop. Those of earlier processes (another pid or start) do not count."""
        record = self._records.get(id)
        ours = record is not None and record.pid == pid and start_id in (record.start_id or start_id, "")
        if record is not None and ours:
            record.heartbeat_s, record.start_id = now_s, start_id or record.start_id
            if record.state is ProcessState.STARTING:
                record.state, record.reason = ProcessState.RUNNING, ""
        if self._is_reference(record, ours=ours):
            if now_s - self._reference_s > LINK_GAP_S:
                self._linked_since_s = now_s
            self._reference_s = now_s

    # -- decisions

    def actions(self, now_s: float) -> list[Action]:
        """Return what is to be done now. SPAWN is to be answered by ``spawned`` or ``not_spawned``."""
        self._forgive(now_s)
        if self._ending:
            self._end_hubs(now_s)
        found: list[Action] = []
        for id_, record in self._records.items():
            verb = self._stopping(record, now_s) if record.alive else self._starting(record, now_s)
            if verb is not None:
                found.append(Action(verb, id_))
        return found

    def next_due_s(self, now_s: float) -> float:
        """Return the time at which ``actions`` is to be asked again at the latest."""
        due = now_s + 0.5
        for record in self._records.values():
            if record.state is ProcessState.WAITING:
                due = min(due, record.start_at_s if self._may_start(record) else now_s + 0.05)
            elif record.state is ProcessState.STOPPING and not record.killed:
                due = min(due, record.stop_asked_s + self._limits.term_grace_s)
        return max(due, now_s)

    def rows(self, now_s: float) -> list[dict[str, Any]]:
        """Return the table of the fleet as plain values."""
        return [row_of(record, now_s) for record in self._records.values()]

    def record(self, id: str) -> ProcessRecord | None:  # noqa: A002
        """Return the record of a process, or None."""
        return self._records.get(id)

    def ids(self) -> list[str]:
        """Return the ids of the fleet in its order."""
        return list(self._records)

    # -- inner

    def _forgive(self, now_s: float) -> None:
        """Take time in which we stood still from nobody: whoever was not heard in it, or had no time to end, begins anew."""
        stood_s = now_s - self._asked_s if self._asked_s > NEVER else 0.0
        self._asked_s = now_s
        if stood_s <= STAND_S:
            return
        for record in self._records.values():
            record.watched_s = now_s
            record.stop_asked_s += stood_s

    def _may_start(self, record: ProcessRecord) -> bool:
        return (self._open and record.spec.role not in self._held) or record.spec.role is Role.HUB

    def _starting(self, record: ProcessRecord, now_s: float) -> Verb | None:
        due = record.wanted and record.state is ProcessState.WAITING and now_s >= record.start_at_s
        return Verb.SPAWN if due and self._may_start(record) else None

    def _stopping(self, record: ProcessRecord, now_s: float) -> Verb | None:
        if record.killed:
            return None
        if record.state is ProcessState.STOPPING:
            return self._escalation(record, now_s)
        if (silent_s := self._silence_s(record, now_s)) is None:
            return None
        record.reason = f"hung: no heartbeat for {silent_s:.1f} s"
        record.hung = record.killed = True
        return Verb.KILL

    def _escalation(self, record: ProcessRecord, now_s: float) -> Verb | None:
        if not record.terminated:
            record.terminated = True
            return Verb.TERMINATE
        if now_s - record.stop_asked_s < self._limits.term_grace_s:
            return None
        record.killed = True
        return Verb.KILL

    def _silence_s(self, record: ProcessRecord, now_s: float) -> float | None:
        """Return how long a hung process has been silent, or None if it is not hung as far as we can know.

        Without a bus nobody is heard, so silence counts only while the reference (our hub, else anybody) is heard.
        """
        timeout_s = max(self._limits.heartbeat_timeout_s, LINK_GAP_S)
        silent_s = now_s - max(record.heartbeat_s, record.watched_s)
        if silent_s <= (timeout_s if record.heartbeat_s > NEVER else max(timeout_s, FIRST_HEARTBEAT_S)):
            return None
        if record.spec.role is Role.HUB:
            return silent_s
        heard = now_s - self._reference_s <= LINK_GAP_S and now_s - self._linked_since_s > timeout_s
        return silent_s if heard else None

    def _is_reference(self, record: ProcessRecord | None, *, ours: bool) -> bool:
        if any(other.spec.role is Role.HUB for other in self._records.values()):
            return ours and record is not None and record.spec.role is Role.HUB
        return True

    def _stopped(self, record: ProcessRecord, now_s: float) -> None:
        if record.wanted:
            record.restarts += 1
            _wait(record, now_s, record.reason)
        else:
            record.state = ProcessState.STOPPED

    def _died(self, record: ProcessRecord, cause: str, now_s: float, *, permanent: bool = False) -> None:
        record.pid, record.reason = 0, cause
        if not record.wanted:
            record.state = ProcessState.STOPPED
            return
        record.deaths_s.append(now_s)
        while now_s - record.deaths_s[0] > self._limits.crash_window_s:
            record.deaths_s.popleft()
        deaths = len(record.deaths_s)
        if permanent or deaths >= self._limits.crash_limit:
            record.state = ProcessState.FAILED
            record.reason = cause if permanent else f"{deaths} deaths in {self._limits.crash_window_s:g} s; the last: {cause}"
            return
        record.restarts += 1
        delay_s = min(self._limits.backoff_last_s, self._limits.backoff_first_s * 2.0 ** (deaths - 1))
        if record.spec.role is Role.HUB and deaths == 1:
            delay_s = 0.0  # everybody waits for it
        _wait(record, now_s + delay_s, cause)

    def _end_hubs(self, now_s: float) -> None:
        hubs = [record for record in self._records.values() if record.spec.role is Role.HUB]
        others = any(record.alive for record in self._records.values() if record.spec.role is not Role.HUB)
        for record in hubs:
            if record.alive and not others and record.state is not ProcessState.STOPPING:
                _ask_to_stop(record, now_s, "the deployment ends")


def _wait(record: ProcessRecord, until_s: float, reason: str) -> None:
    record.state, record.start_at_s, record.reason = ProcessState.WAITING, until_s, reason


def _ask_to_stop(record: ProcessRecord, now_s: float, reason: str) -> None:
    if record.state is not ProcessState.STOPPING and not record.killed:
        record.state, record.stop_asked_s, record.terminated = ProcessState.STOPPING, now_s, False
    record.reason = reason


def _cause(code: int, last_line: str) -> str:
    if code == EXIT_UNKNOWN:
        return f"it ended: {last_line}" if last_line else "it ended"
    if code == 0:
        return "it ended by itself (exit code 0)"
    how = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
    return f"{how}: {last_line}" if last_line else how
