"""The control process: parent of all processes of one deployment on this host, and their table on the network."""

import os
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final

from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.errors import ConfigError, SchemaError
from rtkmesh_schemas.keys import HUB_ID, STATUS, Role
from rtkmesh_schemas.status import Level, ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.control.automation import Automation, RuleSample
from rtkmesh_services.control.base_keys import PresetQuestion, answer, declare_with
from rtkmesh_services.control.base_words import HELP as PRESET_HELP
from rtkmesh_services.control.base_words import PresetDesk
from rtkmesh_services.control.bases import LANE as BASES_LANE
from rtkmesh_services.control.bases import Bases
from rtkmesh_services.control.examination import examine
from rtkmesh_services.control.fleet import LaunchOptions, clean_environment, specs_of
from rtkmesh_services.control.flockwave.service import Flockwave
from rtkmesh_services.control.forking import FORKED, ForkServer
from rtkmesh_services.control.keeper import Keeper
from rtkmesh_services.control.memory import Memory
from rtkmesh_services.control.records import ProcessState
from rtkmesh_services.control.telnet.servers import TelnetServers
from rtkmesh_services.runtime.bus import Liveliness, Sample
from rtkmesh_services.runtime.configuration import load_deployment
from rtkmesh_services.runtime.rule_words import parse_rule
from rtkmesh_services.runtime.service import Context, Report, Service, accepted, done, refused

ALL: Final = frozenset({"all", "*"})
_DEFAULT_LINES: Final = 50
_LASTING: Final = ("deployment", "hub", "control", "flockwave")
_LASTING_TEXT: Final = "[deployment], [hub], [control] and [flockwave]"
_LISTEN_AGAIN_NS: Final = 5_000_000_000
_LEVELS: Final = {ProcessState.FAILED: Level.ERROR, ProcessState.WAITING: Level.WARNING}


class ControlService(Service):
    """Keeps the fleet as the deployment file and the commands want it."""

    role: ClassVar[Role] = Role.CONTROL
    operations: ClassVar[Mapping[str, str]] = {
        "start": "start a process: id=ID, or id=all",
        "stop": "stop a process and leave it stopped: id=ID, or id=all (all but the hub)",
        "restart": "stop a process and start it: id=ID, or id=all (all but the hub)",
        "reload": "read the deployment file again and apply what has changed",
        "preset": PRESET_HELP,
        "output": "the newest lines that a process wrote: id=ID [lines=50]",
    }
    reads: ClassVar[frozenset[str]] = frozenset({"output"})

    def __init__(self, context: Context, keeper: Keeper, options: LaunchOptions) -> None:
        super().__init__(context)
        self._keeper, self._options = keeper, options
        self._deployment: Deployment = context.deployment
        self._bases = Bases(context, keeper, options)
        self._presets = PresetDesk(self._bases.book, self._bases)
        self._flockwave = Flockwave(context, self._bases.book)
        self._telnet = TelnetServers(context)
        self._telnet_ns = 0
        self._automation = Automation(context)

    def open(self) -> None:
        """Listen to the heartbeats of all, and to what rules watch; say what we have found running."""
        if text := self._keeper.found.in_words():
            self.context.event(Level.INFO, "taken_over", text)
        self._keeper.on_change(self._changed)
        self._apply_rules()
        self.context.subscribe(STATUS.expression(), lane="status", latest=True)
        self._bases.open(declare_with(self.context, BASES_LANE))
        self._flockwave.open()
        self._telnet.apply(self._deployment.telnet)

    def handle(self, item: Any) -> None:
        """Take a status, the heartbeat of a work loop; what concerns base stations or Flockwave; a message that a rule watches."""
        if isinstance(item, PresetQuestion):
            answer(self._presets, item, self.context)
        if isinstance(item, RuleSample | Liveliness):
            self._automation.take(item, self._now_s())
        if self._bases.took(item) or self._flockwave.handle(item) or not isinstance(item, Sample):
            return
        try:
            status = decode(ServiceStatus, item.payload, item.encoding)
        except SchemaError as error:
            self.context.log.debug("a status that is none on %s: %s", item.key, error)
            return
        self._keeper.heartbeat(status.id, status.pid, item.received_mono_ns * 1e-9, status.start_id)
        self._take_word(status)
        self._bases.heard(status, item.received_mono_ns * 1e-9)
        self._flockwave.status(status, item.received_mono_ns)

    def _take_word(self, status: ServiceStatus) -> None:
        """Remember of a solver that commands have made it run or stop, for the process that may come after it."""
        table, running = self._deployment.solver.get(status.id), status.data.get("running")
        if table is not None and isinstance(running, bool):
            self._keeper.solver_told(status.id, status.pid, None if running == table.autostart else running)

    def tick(self, now_mono_ns: int) -> None:
        """Bring the base stations to what is wanted; let time act on the rules; try again what could not listen."""
        self._bases.tick(now_mono_ns * 1e-9)
        self._flockwave.tick(now_mono_ns)
        self._automation.tick(now_mono_ns * 1e-9)
        if now_mono_ns - self._telnet_ns >= _LISTEN_AGAIN_NS:
            self._telnet_ns = now_mono_ns
            self._telnet.try_again()

    def close(self) -> None:
        """Ask no solver any more, let the rules go, stop listening."""
        self._bases.close()
        self._flockwave.close()
        self._automation.close()
        self._telnet.close()

    def command(self, request: Request) -> Reply:
        """Act on the desired state of processes."""
        if request.op == "reload":
            return self._reload()
        if request.op == "preset":
            return self._presets.command(request)
        id_ = str(request.args.get("id", request.args.get("name", "")))
        known = [row["id"] for row in self._keeper.rows()]
        if not id_:
            return refused(Code.BAD_ARGUMENTS, f"say which process: id=ID, one of {', '.join(known)}, or id=all")
        if id_ not in known and (id_ not in ALL or request.op == "output"):
            return refused(Code.NOT_FOUND, f"no process {id_!r}; there are {', '.join(known)}")
        if request.op == "output":
            return self._output(id_, request.args.get("lines", _DEFAULT_LINES))
        ids = [id_] if id_ in known else [name for name in known if name != HUB_ID]
        act: dict[str, Callable[[str], None]] = {
            "start": self._keeper.start,
            "stop": self._keeper.stop,
            "restart": self._keeper.restart,
        }
        for name in ids:
            act[request.op](name)
        return accepted(f"{request.op}: {', '.join(ids)}", ids=ids)

    def report(self) -> Report:
        """Return the whole table; DEGRADED while a process has failed."""
        rows = self._keeper.rows()
        failed = [f"{row['role']} {row['id']} FAILED: {row['reason']}" for row in rows if row["state"] == ProcessState.FAILED]
        counters = {
            "processes": len(rows),
            "running": sum(row["state"] == ProcessState.RUNNING for row in rows),
            "failed": len(failed),
            "restarts": sum(row["restarts"] for row in rows),
            "listener_errors": self._keeper.listener_errors,
            **self._flockwave.counters(),
            **self._telnet.counters(),
        }
        faults = [*failed, *self._telnet.faults]
        state = State.DEGRADED if faults else State.RUNNING
        data = {"processes": rows, "rules": self._automation.report(), **self._bases.data()}
        return Report(state=state, reason="; ".join(faults), counters=counters, data=data)

    def _output(self, id_: str, lines: Any) -> Reply:
        try:
            count = int(lines)
        except (TypeError, ValueError):
            return refused(Code.BAD_ARGUMENTS, f"lines={lines!r} is no number")
        return done(f"the last lines of {id_}", lines=self._keeper.last_lines(id_, count))

    def _reload(self) -> Reply:
        try:
            deployment = load_deployment(self._options.file, self._options.data_folder, self._options.speed)
        except ConfigError as error:
            return refused(Code.BAD_ARGUMENTS, f"nothing is changed: {error}")
        if any(getattr(deployment, name) != getattr(self._deployment, name) for name in _LASTING):
            return refused(Code.NOT_ALLOWED, f"nothing is changed: {_LASTING_TEXT} need a new `rtkmesh up`")
        if deployment != self._deployment and (faults := examine(self._options.file, self._options.data_folder)):
            return refused(Code.BAD_ARGUMENTS, f"nothing is changed: {faults}")
        self._deployment = deployment
        self._telnet.apply(deployment.telnet)
        self._apply_rules()
        changes = self._keeper.apply(specs_of(deployment, self._options))
        self._bases.reload(deployment)
        text = "; ".join(f"{what}: {', '.join(ids)}" for what, ids in changes.items() if ids)
        return accepted(text or "nothing has changed", **changes)

    def _apply_rules(self) -> None:
        rules = [parse_rule(name, table) for name, table in self._deployment.rule.items()]
        self._automation.apply(rules, self._now_s())

    def _now_s(self) -> float:
        return self.context.clock.mono_ns() * 1e-9

    def _changed(self, row: dict[str, Any]) -> None:
        """Tell the network of a change (called in the keeper's thread)."""
        state = ProcessState(row["state"])
        if self.context.stopping.is_set() or (state is ProcessState.STARTING and not row["restarts"]):
            return
        reason = f": {row['reason']}" if row["reason"] else ""
        text = f"{row['role']} {row['id']} is {state}{reason}"
        logged = state is not ProcessState.RUNNING or row["restarts"] > 0  # a process says itself that it runs
        self.context.event(_LEVELS.get(state, Level.INFO), f"process_{state.lower()}", text, logged=logged, **row)


def keeper_of(deployment: Deployment, options: LaunchOptions, memory: Memory | None = None) -> Keeper:
    """Return the keeper of a deployment's fleet, not yet begun."""
    listen = deployment.hub.listen[0] if deployment.hub.enabled and deployment.hub.listen else ""
    specs = specs_of(deployment, options)
    roles = tuple(role for role in FORKED if any(spec.role is role for spec in specs))
    server = ForkServer(roles, clean_environment(os.environ, Role.SOLVER)) if roles else None
    return Keeper(specs, deployment.control, listen, fork_server=server, memory=memory)
