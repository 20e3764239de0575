"""The thread that keeps the fleet as the supervisor wants it: spawns, reads output, reaps, signals."""

import contextlib
import logging
import os
import selectors
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

from rtkmesh_schemas.config import ControlTable
from rtkmesh_schemas.keys import HUB_ID, Role
from rtkmesh_services.control.adoption import Adopted, Findings, sort_out
from rtkmesh_services.control.endpoints import accepts
from rtkmesh_services.control.fleet import ProcessSpec, restarts_between
from rtkmesh_services.control.forking import ForkServer
from rtkmesh_services.control.memory import Memory
from rtkmesh_services.control.output import OutputLine, OutputLog, ProcessLog
from rtkmesh_services.control.process import Child, Started, start_program
from rtkmesh_services.control.records import Action, ProcessRecord, ProcessState, Verb
from rtkmesh_services.control.registry import ProcessEntry
from rtkmesh_services.control.supervisor import Supervisor
from rtkmesh_services.runtime.host_processes import uptime_s
from rtkmesh_services.runtime.process import RUNNING_VARIABLE

_HUB_READY_S: Final = 5.0  # after this the others start even if the hub takes no connection: they retry on their own
_POLL_S: Final = 0.1  # without pidfd
_TOLD: Final = {None: "", True: "start", False: "stop"}
_LEVELS: Final = {"debug": logging.DEBUG, "info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}
logger = logging.getLogger("rtkmesh.control")

ChangeListener = Callable[[dict[str, Any]], None]


class Keeper:
    """Runs a fleet until ``end``. All methods may be called from any thread; processes belong to the keeper's own."""

    def __init__(
        self,
        specs: list[ProcessSpec],
        limits: ControlTable,
        hub_endpoint: str = "",
        on_line: Callable[[OutputLine], None] | None = None,
        clock_s: Callable[[], float] = time.monotonic,
        fork_server: ForkServer | None = None,
        memory: Memory | None = None,
    ) -> None:
        self._lock = threading.Lock()
        self._clock_s = clock_s
        self._supervisor = Supervisor(limits)
        self._specs = specs
        self._hub_endpoint = hub_endpoint
        self._hub_wait_until_s = 0.0
        self._fork_server = fork_server
        self._memory = memory or Memory()
        self.found = Findings()
        self._unclaimed: set[str] = set()
        self._let_go = False
        self._children: dict[str, Child | Adopted] = {}
        self._selector = selectors.DefaultSelector()
        self._wake_reader, self._wake_writer = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._output = OutputLog()
        self._show_line = on_line or _log_line
        self._listeners: list[ChangeListener] = []
        self.listener_errors = 0
        self.listener_error: Exception | None = None
        self._seen: dict[str, tuple[Any, ...]] = {}
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)

    # -- for the other threads

    def begin(self) -> None:
        """Start the thread and the fleet, the hub first; what an earlier control left running is taken over."""
        with self._lock:
            self._take_over()
        self._hub_wait_until_s = self._clock_s() + _HUB_READY_S
        self._thread.start()

    def end(self, timeout_s: float = 10.0) -> bool:
        """Stop everything, the hub last; True when no process is left."""
        with self._lock:
            self._supervisor.end(self._clock_s())
        return self._joined(timeout_s)

    def let_go(self, timeout_s: float = 5.0) -> bool:
        """End the watch, not the processes: the next control takes them over. True when it is done."""
        self._let_go = True
        return self._joined(timeout_s)

    def on_change(self, listener: ChangeListener) -> None:
        """Call ``listener`` with the row of a process whenever its state, pid or reason changes (in the keeper's thread)."""
        self._listeners.append(listener)

    def rows(self) -> list[dict[str, Any]]:
        """Return the table of the fleet."""
        with self._lock:
            rows, told = self._supervisor.rows(self._clock_s()), self._memory.desired.solvers
        return [{**row, "told": _TOLD[told.get(row["id"])]} for row in rows]

    def state_of(self, id: str) -> ProcessState | None:  # noqa: A002  the word of the design
        """Return the state of a process, or None if there is none of this id."""
        with self._lock:
            record = self._supervisor.record(id)
            return None if record is None else record.state

    def start(self, id: str) -> None:  # noqa: A002
        """Want a process."""
        self._change(lambda now_s: self._supervisor.start(id, now_s), id, wanted=True)

    def stop(self, id: str) -> None:  # noqa: A002
        """Want a process no more."""
        self._change(lambda now_s: self._supervisor.stop(id, now_s), id, wanted=False)

    def restart(self, id: str) -> None:  # noqa: A002
        """Stop and start a process."""
        self._change(lambda now_s: self._supervisor.restart(id, now_s), id, wanted=True)

    def heartbeat(self, id: str, pid: int, received_s: float, start_id: str = "") -> None:  # noqa: A002
        """Hand over a status of a process: its pid, when it came (monotonic), and the name of this run of it."""
        with self._lock:
            self._supervisor.heartbeat(id, pid, received_s, start_id)
        self._wake()

    def solver_told(self, id: str, pid: int, running: bool | None) -> None:  # noqa: A002
        """Note that a solver of ours was told to start or stop, for the process that comes after it; None: it is as its table says."""
        with self._lock:
            record = self._supervisor.record(id)
            if record is None or record.pid != pid or self._memory.desired.solvers.get(id) == running:
                return
            self._memory.desired = self._memory.desired.with_solver(id, running)
        self._wake()

    def apply(self, specs: list[ProcessSpec]) -> dict[str, list[str]]:
        """Make the fleet that of ``specs``; return the ids that are removed, added and restarted."""
        with self._lock:
            now_s = self._clock_s()
            removed, added, changed = restarts_between(self._specs, specs)
            for id_ in removed:
                self._supervisor.remove(id_, now_s)
            for spec in added:
                self._supervisor.add(spec)
            for spec in changed:
                self._supervisor.replace(spec, now_s)
            self._specs = specs
            self._memory.desired = self._memory.desired.without(set(removed))
        self._wake()
        return {"removed": removed, "added": [s.id for s in added], "restarted": [s.id for s in changed]}

    def include(self, spec: ProcessSpec) -> None:
        """Keep a further process, beside those of ``apply``; another definition of one that is there restarts it."""
        with self._lock:
            child = self._children.get(spec.id)
            if spec.id in self._unclaimed and isinstance(child, Adopted) and child.definition == spec.definition:
                child.recognised(spec)
                self._supervisor.recognise(spec)
            else:
                self._supervisor.include(spec, self._clock_s())
            self._unclaimed.discard(spec.id)
        self._wake()

    def dismiss(self, id: str) -> None:  # noqa: A002
        """Stop a process that was included, and forget it."""
        with self._lock:
            if self._supervisor.record(id) is not None:
                self._supervisor.remove(id, self._clock_s())
        self._wake()

    def end_unclaimed(self) -> None:
        """End the further processes of an earlier control that nobody has included."""
        for id_ in list(self._unclaimed):
            self._unclaimed.discard(id_)
            self.dismiss(id_)

    def last_lines(self, id: str, count: int) -> list[str]:  # noqa: A002
        """Return the newest lines that a process wrote."""
        with self._lock:
            record = self._supervisor.record(id)
            if record is not None and record.spec.log_file is not None:
                return ProcessLog(record.spec).last(count)
            return self._output.last(id, count)

    # -- the keeper's own thread

    def _run(self) -> None:
        self._selector.register(self._wake_reader, selectors.EVENT_READ, None)
        self._remember()
        while True:
            self._tend_fork_server()
            self._open_gate()
            with self._lock:
                now_s = self._clock_s()
                actions, due_s, ended = self._supervisor.actions(now_s), self._supervisor.next_due_s(now_s), self._supervisor.ended
            for action in actions:
                self._act(action)
            self._tell()
            if ended or self._let_go:
                break
            self._wait(0.0 if actions else due_s - now_s)
            self._reap()
        if self._fork_server is not None:
            self._fork_server.close()
        self._selector.close()

    def _act(self, action: Action) -> None:
        if action.verb is Verb.SPAWN:
            self._spawn(action.id)
        elif child := self._children.get(action.id):
            child.signal(signal.SIGTERM if action.verb is Verb.TERMINATE else signal.SIGKILL)

    def _spawn(self, id_: str) -> None:
        """Start a process. Under the lock: no command may come between the decision and its deed."""
        with self._lock:
            record = self._supervisor.record(id_)
            if record is None or not record.wanted:
                return
            try:
                child = Child(self._as_told(record.spec), self._line, self._start)
            except OSError as error:
                self._supervisor.not_spawned(id_, str(error), self._clock_s())
                return
            self._supervisor.spawned(id_, child.pid, self._clock_s())
        self._keep(id_, child)
        self._remember()  # at once: should we die now, the next control knows it

    def _as_told(self, spec: ProcessSpec) -> ProcessSpec:
        """Return the spec for a solver that goes on as the one before it was told."""
        running = self._memory.desired.solvers.get(spec.id)
        return spec if running is None else replace(spec, environment={**spec.environment, RUNNING_VARIABLE: str(int(running))})

    def _keep(self, id_: str, child: Child | Adopted) -> None:
        self._children[id_] = child
        for descriptor in child.descriptors():
            self._selector.register(descriptor, selectors.EVENT_READ, child)

    def _take_over(self) -> None:
        """Fill the fleet with what is wanted, and with what runs of it."""
        left, stopped = self._memory.left, self._memory.desired.stopped
        found = sort_out(left.processes, left.alive, self._specs)
        removed = [entry.unwanted_spec() for entry in found.removed.values()]
        for spec in [*self._specs, *removed]:
            entry = left.processes.get(spec.id)
            restarts = 0 if entry is None else entry.restarts + (spec.id in found.ended)
            reason = "stopped by command" if spec.id in stopped else "it ended while no control was there" if spec.id in found.ended else ""
            self._supervisor.add(spec, wanted=spec.id not in stopped, restarts=restarts, reason=reason)
            if entry is not None and spec.id in found.running:
                self._adopt(spec, entry)
        now_s = self._clock_s()
        for id_ in found.running:
            if id_ in found.removed and left.processes[id_].further:
                self._unclaimed.add(id_)
            elif id_ in found.removed:
                self._supervisor.remove(id_, now_s)
            elif id_ in stopped:
                self._supervisor.stop(id_, now_s)
            elif id_ in found.changed:
                self._supervisor.restart(id_, now_s, "its table has changed")
        self.found = found

    def _adopt(self, spec: ProcessSpec, entry: ProcessEntry) -> None:
        assert entry.identity is not None, "only what runs is adopted"
        try:
            child = Adopted(spec, entry.identity, entry.definition)
        except ProcessLookupError:  # it ended this moment: it is started anew
            return
        now_s = self._clock_s()
        self._supervisor.adopt(spec.id, child.pid, entry.start_id, now_s - uptime_s(child.identity), now_s)
        self._keep(spec.id, child)

    def _remember(self) -> None:
        """Keep on disk what is known and wanted."""
        with self._lock:
            records = [record for id_ in self._supervisor.ids() if (record := self._supervisor.record(id_)) is not None]
            entries = [self._entry(record) for record in records]
            self._memory.write(entries)

    def _entry(self, record: ProcessRecord) -> ProcessEntry:
        child = self._children.get(record.spec.id)
        return ProcessEntry(
            id=record.spec.id,
            role=record.spec.role,
            definition=(record.spec if child is None else child).definition,
            identity=None if child is None else child.identity,
            start_id=record.start_id,
            state=str(record.state),
            reason=record.reason,
            restarts=record.restarts,
            further=all(spec.id != record.spec.id for spec in self._specs),
        )

    def _wait(self, timeout_s: float) -> None:
        if any(child.exit_descriptor is None for child in self._children.values()):
            timeout_s = min(timeout_s, _POLL_S)
        for key, _ in self._selector.select(max(timeout_s, 0.0)):
            child: Child | Adopted | ForkServer | None = key.data
            if isinstance(child, ForkServer):
                child.read()
            elif child is None:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._wake_reader, 4096)
            elif key.fd != child.exit_descriptor and not child.read(key.fd):
                self._selector.unregister(key.fd)

    def _reap(self) -> None:
        for id_, child in list(self._children.items()):
            descriptors = child.descriptors()
            code = child.reap()
            if code is None:
                continue
            for descriptor in descriptors:
                with contextlib.suppress(KeyError):
                    self._selector.unregister(descriptor)
            del self._children[id_]
            with self._lock:
                self._supervisor.exited(id_, code, child.last_error, self._clock_s())

    def _start(self, spec: ProcessSpec) -> Started:
        forked = None if self._fork_server is None else self._fork_server.start(spec)
        return start_program(spec) if forked is None else forked

    def _tend_fork_server(self) -> None:
        """Keep the fork server, and hold the processes that are to come from it until it is ready."""
        server, now_s = self._fork_server, self._clock_s()
        if server is None:
            return
        server.tend(now_s, self._selector)
        with self._lock:
            self._supervisor.hold(server.held(now_s))

    def _open_gate(self) -> None:
        """Let the others start when the hub takes connections: they would else take its processor and then wait for a retry."""
        if self._hub_wait_until_s == 0.0:
            return
        has_hub = any(spec.role is Role.HUB for spec in self._specs)
        if not has_hub or self._clock_s() > self._hub_wait_until_s or (HUB_ID in self._children and accepts(self._hub_endpoint)):
            self._hub_wait_until_s = 0.0
            with self._lock:
                self._supervisor.hub_ready()

    def _line(self, line: OutputLine) -> None:
        with self._lock:
            self._output.add(line)
        self._call(lambda: self._show_line(line))

    def _tell(self) -> None:
        rows, changes = self.rows(), 0
        for row in rows:
            now = (row["state"], row["pid"], row["reason"])
            if self._seen.get(row["id"]) != now:
                self._seen[row["id"]] = now
                changes += 1
                for listener in self._listeners:
                    self._call(partial(listener, row))
        gone = set(self._seen) - {row["id"] for row in rows}
        if changes or gone or self._memory.is_new:
            self._remember()
        for id_ in gone:
            del self._seen[id_]

    def _call(self, foreign: Callable[[], None]) -> None:
        """Call what others gave us: their fault must not leave the fleet without its keeper."""
        try:
            foreign()
        except Exception as error:  # noqa: BLE001  counted; logging it may be what failed
            self.listener_errors += 1
            self.listener_error = error

    def _change(self, act: Callable[[float], None], id_: str, *, wanted: bool) -> None:
        with self._lock:
            act(self._clock_s())
            self._memory.desired = self._memory.desired.with_process(id_, wanted=wanted)
        self._wake()

    def _joined(self, timeout_s: float) -> bool:
        self._wake()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake_writer, b"w")


def _log_line(line: OutputLine) -> None:
    level = _LEVELS.get(line.level, logging.WARNING if line.error_stream and not line.structured else logging.INFO)
    logger.log(level, "%s | %s", line.id, line.text, extra={"instance": line.id})
