"""Rules at work: listens to their keys, and gives their commands from a thread of its own, again to processes that come later."""

import fnmatch
import hashlib
import queue
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec

from rtkmesh_schemas.command import Code, Reply
from rtkmesh_schemas.keys import CONTROL_ID, HUB_ID, stream_of
from rtkmesh_schemas.status import Level
from rtkmesh_services.control.rules import Change, RuleState
from rtkmesh_services.errors import BusError
from rtkmesh_services.runtime.bus import Handle, Liveliness, Sample
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.rule_words import EVENT, Action, Rule, message_of
from rtkmesh_services.runtime.service import Context
from rtkmesh_services.runtime.state_files import locked, state_folder, write_state

LANE: Final = "rules"
CALLER: Final = "rule {}"
CALL_S: Final = 2.0
TRIES: Final = 3
_WAITING_JOBS: Final = 256
_NOT_OURS: Final = frozenset({CONTROL_ID, HUB_ID})  # a pattern never means them; their names do
# There is nothing to do: it is as the rule wants it, or a process that a pattern matches has no such operation.
_CONTENT: Final = frozenset({Code.OK, Code.ACCEPTED, Code.WRONG_STATE})


class BegunRules(msgspec.Struct, kw_only=True):
    """The file: which rules had begun on which keys, so that their end is not missed over a restart of control."""

    version: int = 1
    begun: dict[str, list[str]] = {}


@dataclass(frozen=True, slots=True)
class RuleSample:
    """A message for one rule."""

    name: str
    sample: Sample


@dataclass(frozen=True, slots=True)
class Job:
    """A command to give. ``only``: to this process that has just come, if the command is meant for it."""

    change: Change
    action: Action
    only: str = ""


@dataclass(slots=True)
class _Row:
    state: RuleState
    handle: Handle
    errors: int = 0
    last_error: str = ""


@dataclass(slots=True)
class Automation:
    """All rules of a deployment. But for its thread it belongs to control's loop."""

    context: Context
    memory: Path | None = None
    _rows: dict[str, _Row] = field(default_factory=dict[str, _Row])
    _jobs: "queue.Queue[Job | None]" = field(default_factory=lambda: queue.Queue(_WAITING_JOBS))
    _thread: threading.Thread | None = None
    _live: Handle | None = None

    def apply(self, rules: Iterable[Rule], now_s: float) -> None:
        """Watch these rules and no others; one that has not changed goes on as it is."""
        wanted = {rule.name: rule for rule in rules if rule.table.enabled}
        for name in [name for name, row in self._rows.items() if wanted.get(name) != row.state.rule]:
            self._rows.pop(name).handle.close()
        before = self._remembered() if wanted else {}
        for name, rule in wanted.items():
            if name not in self._rows:
                state = RuleState(rule, now_s, tuple(before.get(name, ())))
                self._rows[name] = _Row(state, self._watch(rule))
        if self._rows and self._thread is None:
            self._thread = threading.Thread(target=self._work, name="rules", daemon=True)
            self._thread.start()
            self._live = self.context.bus.on_live(lambda change: self.context.inbox.put(change, lane=LANE))

    def take(self, item: RuleSample | Liveliness, now_s: float) -> None:
        """Take a message for a rule, or that a process has come."""
        if isinstance(item, Liveliness):
            if item.alive:
                self._welcome(item.id)
            return
        row = self._rows.get(item.name)
        if row is None:
            return
        try:
            message = message_of(item.sample.payload, item.sample.encoding)
        except ValueError as error:
            self._unread(row, item.sample.key, str(error))
            return
        if (change := row.state.take(item.sample.key, message, now_s)) is not None:
            self._changed([change])

    def tick(self, now_s: float) -> None:
        """Let time act."""
        self._changed([change for row in self._rows.values() for change in row.state.tick(now_s)])

    def report(self) -> dict[str, Any]:
        """Return, per rule, where it holds, what it saw, how often it acted, and what went wrong."""
        return {
            name: {
                "when": f"{row.state.rule.table.key}: {row.state.rule.table.when}",
                "begun": row.state.begun,
                "seen": row.state.seen,
                "changes": row.state.changes,
                "errors": row.errors,
                "last_error": row.last_error,
            }
            for name, row in self._rows.items()
        }

    def given(self) -> None:
        """Wait until all commands are given."""
        self._jobs.join()

    def close(self) -> None:
        """Stop listening; a command that is being given is not waited for."""
        for row in self._rows.values():
            row.handle.close()
        if self._live is not None:
            self._live.close()
        if self._thread is not None:
            self._put(None)

    def _watch(self, rule: Rule) -> Handle:
        def hand_over(sample: Sample) -> None:
            self.context.inbox.put(RuleSample(rule.name, sample), lane=LANE, key=(rule.name, sample.key))

        return self.context.bus.subscribe(rule.table.key, hand_over, history=stream_of(rule.table.key) is not None)

    def _changed(self, changes: Sequence[Change]) -> None:
        for change in changes:
            rule, word = change.rule, "begins" if change.begun else "ends"
            text = f"rule {rule.name} {word}: {change.key} {rule.table.when}" + (
                f", it is {change.value}" if change.value is not None else ""
            )
            code = "rule_begun" if change.begun else "rule_ended"
            self.context.event(Level.INFO, code, text, rule=rule.name, key=change.key, value=change.value)
            for action in rule.do if change.begun else rule.at_end:
                self._put(Job(change, action))
        if changes:
            self._remember()

    def _welcome(self, id_: str) -> None:
        """Give a process that has come the commands of the rules that hold: it may have missed them."""
        for row in self._rows.values():
            for key in row.state.begun:
                change = Change(row.state.rule, key, begun=True, value=row.state.seen[key])
                for action in row.state.rule.do:
                    if action.operation != EVENT:
                        self._put(Job(change, action, only=id_))

    def _put(self, job: Job | None) -> None:
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            self.context.event(Level.ERROR, "rule_failed", "too many commands of rules wait: one is not given")

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None and not self.context.stopping.is_set():
            try:
                self._act(job)
            except BusError as error:
                self._failed(job, str(error))
            finally:
                self._jobs.task_done()

    def _act(self, job: Job) -> None:
        action, name = job.action, job.change.rule.name
        if action.operation == EVENT:
            self.context.event(Level(action.target), "rule", action.text, rule=name, key=job.change.key)
            return
        for id_ in self._targets(job):
            reply = self._ask(id_, action, name)
            if reply.code not in _CONTENT and not (reply.code is Code.UNKNOWN_OP and "*" in action.target):
                self._failed(job, f"{action.operation} {id_}: {reply.code.value}: {reply.message}")
            elif reply.ok:
                self.context.event(
                    Level.INFO, "rule_acted", f"rule {name}: {action.operation} {id_}: {reply.message}", rule=name, target=id_
                )

    def _targets(self, job: Job) -> list[str]:
        owner = stream_of(job.change.key)
        pattern = job.action.target.replace("{id}", owner[1] if owner else "")
        known = [job.only] if job.only else sorted(self.context.bus.live()) if "*" in pattern else [pattern]
        return [id_ for id_ in known if fnmatch.fnmatchcase(id_, pattern) and (id_ == pattern or id_ not in _NOT_OURS)]

    def _ask(self, id_: str, action: Action, name: str) -> Reply:
        reply = Reply(ok=False, code=Code.ABSENT)
        for _ in range(TRIES):
            reply = call(self.context.bus, id_, action.operation, action.arguments, CALL_S, caller=CALLER.format(name))[0]
            if reply.code not in {Code.ABSENT, Code.HUNG} or self.context.wait(1.0):
                break
        return reply

    def _failed(self, job: Job, text: str) -> None:
        name = job.change.rule.name
        if (row := self._rows.get(name)) is not None:
            row.errors, row.last_error = row.errors + 1, text
        self.context.event(Level.ERROR, "rule_failed", f"rule {name}: {text}", rule=name, key=job.change.key)

    def _unread(self, row: _Row, key: str, error: str) -> None:
        row.errors += 1
        if row.last_error != error:
            row.last_error = error
            text = f"rule {row.state.rule.name}: a message on {key} is neither JSON nor msgpack nor text: {error}"
            self.context.event(Level.WARNING, "rule_unread", text, rule=row.state.rule.name, key=key)

    @property
    def _file(self) -> Path:
        site = f"{self.context.config_file}|{self.context.deployment.deployment.namespace}"
        return (self.memory or state_folder()) / f"rules-{hashlib.sha256(site.encode()).hexdigest()[:12]}.json"

    def _remember(self) -> None:
        begun = {name: row.state.begun for name, row in self._rows.items() if row.state.begun}
        self._kept(lambda: write_state(self._file, msgspec.json.encode(BegunRules(begun=begun))))

    def _remembered(self) -> dict[str, list[str]]:
        try:
            return msgspec.json.decode(self._file.read_bytes(), type=BegunRules).begun
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.MsgspecError) as error:
            self.context.log.warning("%s: %s; rules begin anew", self._file, error)
            return {}

    def _kept(self, write: Callable[[], None]) -> None:
        try:
            with locked(self._file):
                write()
        except OSError as error:
            self.context.log.warning("%s: %s; what rules have begun is not remembered", self._file, error)
