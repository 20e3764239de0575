"""``rtkmesh up``: control in the foreground, parent of all processes of a deployment file."""

import json
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from cyclopts import Parameter

from rtkmesh_schemas.keys import CONTROL_ID, HUB_ID, Role
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_services.cli.board import Board
from rtkmesh_services.cli.check import url_errors
from rtkmesh_services.cli.detach import Announcement, detached
from rtkmesh_services.cli.holding import Holding, hub_runs, port_holder
from rtkmesh_services.cli.network import Json
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.cli.table import Display, View
from rtkmesh_services.control.endpoints import is_free
from rtkmesh_services.control.fleet import LaunchOptions
from rtkmesh_services.control.keeper import Keeper
from rtkmesh_services.control.memory import Memory
from rtkmesh_services.control.records import ProcessState
from rtkmesh_services.control.service import ControlService, keeper_of
from rtkmesh_services.errors import BusError, UnreachableError
from rtkmesh_services.runtime.bus import Bus, endpoints_for
from rtkmesh_services.runtime.configuration import ConfigErrors, Site, load_site
from rtkmesh_services.runtime.process import EXIT_OK, EXIT_SITE, leave, run_service
from rtkmesh_services.runtime.service import Context, Service

EXIT_FAILED: Final = 1
_CONNECT_S: Final = 1.0
_IDLE_S: Final = 10.0
_FAREWELL_S: Final = 3.0  # above the grace times of processes and hub


def up(
    file: Annotated[Path, Parameter(help="The deployment file (TOML).")],
    /,
    *,
    data: Annotated[Path | None, Parameter(help="Folder of the recordings: what {data} stands for (default: RTKMESH_DATA).")] = None,
    speed: Annotated[str, Parameter(help="Replay recordings at this speed: 1, 10, ... or max.")] = "",
    as_json: Json = False,
    quiet: Annotated[bool, Parameter(negative="", help="No table, no summary.")] = False,
    exit_at_end: Annotated[bool, Parameter(negative="", help="End when all recordings are played and solved.")] = False,
    detach: Annotated[bool, Parameter(name=["--detach", "-d"], negative="", help="In the background; return when all run.")] = False,
    outlive: Annotated[bool, Parameter(negative="", help="In the foreground, but processes outlive it (for systemd).")] = False,
    fresh: Annotated[bool, Parameter(negative="", help="Forget which processes commands had stopped.")] = False,
    timeout: Annotated[float, Parameter(help="With --detach: seconds until it returns at the latest.")] = 60.0,
) -> None:
    """Run all processes of a deployment: starts them, watches them, replaces what dies or hangs.

    Ctrl-C ends them all; none is left, whatever happens to this process. On a terminal it shows a live table.

    With --detach (or --outlive) they run on when it is killed or crashes. The same command again takes over what runs, starts what
    is missing, ends what is in the file no more and restarts what has changed; nothing else is touched. `rtkmesh down` ends it all.

    What commands have stopped stays stopped with the next start, unless it is --fresh.

    Exit codes: 0 ended as asked (with --detach: all run), 1 a process failed (with --exit-at-end, --detach) or does not run in time,
    2 the file or the site is at fault, such as a busy port or a control that is there already.
    """
    site = load_site(file, data, speed)
    if errors := url_errors(file, site.deployment):
        raise ConfigErrors(errors)
    if detach:
        leave(detached(site, speed, fresh=fresh, timeout_s=timeout, as_json=as_json))
    options = LaunchOptions(site.file, site.data_folder, speed)
    ends = AtEnd(site) if exit_at_end else never
    holding = Holding(site, outlive=outlive, fresh=fresh)
    foreground = Foreground(site, options, as_json=as_json, quiet=quiet, ends=ends, holding=holding)
    code = foreground.run()
    foreground.report()
    leave(code)


Ending = Callable[["Foreground"], tuple[str, int] | None]


@dataclass(slots=True)
class Foreground:
    """Control with a picture: runs a deployment and watches it. ``ends`` says when it is enough: (why, exit code)."""

    site: Site
    options: LaunchOptions
    as_json: bool = False
    quiet: bool = False
    ends: Ending = field(default=lambda _: None)
    board: Board = field(default_factory=Board)
    view: View | None = None
    holding: Holding | None = None  # what is kept on disk; None: nothing
    prepare: Callable[[], None] | None = None  # what the view needs and takes time to import
    reason: str = ""
    seconds: float = 0.0
    rows: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    _code: int = 0
    _keeper: Keeper | None = None
    _service: Service | None = None
    _done: threading.Event = field(default_factory=threading.Event)

    def run(self) -> int:
        """Run until the end; return the exit code. No process is left, but those that outlive a control that was not asked to end."""
        started_s, code = time.monotonic(), EXIT_FAILED
        memory = Memory() if self.holding is None else self.holding.take()
        if not hub_runs(memory, self.site):
            require_free(self.site)
        options = self.options if self.holding is None else self.holding.options(self.options)
        keeper = self._keeper = keeper_of(self.site.deployment, options, memory)
        if self.as_json:
            keeper.on_change(lambda row: print_json({"event": "process", **row}))
        display = self._display(keeper)
        watcher = threading.Thread(target=self._watch, args=(display,), name="view", daemon=True)
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # until ``run_service`` watches for it
        try:
            keeper.begin()
            watcher.start()
            control = self.site.deployment.control
            code = run_service(
                lambda context: self._create(context, keeper, options),
                role=Role.CONTROL,
                id=CONTROL_ID,
                site=self.site,
                open_bus=lambda: connect(self.site, keeper),
                end_s=2.0 * control.term_grace_s + _FAREWELL_S,
            )
        except KeyboardInterrupt:
            code = EXIT_OK
        finally:
            self.rows = keeper.rows()
            clean = _finish(keeper, memory, lets_go=options.logs is not None and code not in (EXIT_OK, EXIT_SITE))
            self._done.set()
            watcher.join(1.0)
        self.seconds = time.monotonic() - started_s
        return code or self._code or (0 if clean else EXIT_FAILED)

    def processes(self) -> list[dict[str, Any]]:
        """Return the table of the fleet of this moment."""
        return self._keeper.rows() if self._keeper is not None else []

    def report(self) -> None:
        """Print how it was."""
        solvers = {
            id_: {"epochs": track.count, "fixed": track.fixes, "fix_pct": round(100.0 * track.fixes / track.count, 2)}
            for id_, track in self.board.solutions.items()
        }
        if self.as_json:
            print_json(
                {"event": "end", "reason": self.reason, "seconds": round(self.seconds, 2), "solvers": solvers, "processes": self.rows}
            )
        elif not self.quiet:
            why = f" ({self.reason})" if self.reason else ""
            restarts = sum(row["restarts"] for row in self.rows)
            solved = [f"{id_}: {row['epochs']} epochs, {row['fix_pct']:.1f} % FIX" for id_, row in solvers.items()]
            sys.stderr.write("; ".join([f"ended after {self.seconds:.1f} s{why}", f"{restarts} restarts", *solved]) + "\n")

    def _create(self, context: Context, keeper: Keeper, options: LaunchOptions) -> Service:
        if (self.quiet and options.logs is None) or sys.stdout.isatty():
            logging.getLogger().setLevel(logging.WARNING)  # the table says the rest
        self._service = ControlService(context, keeper, options)
        self.board.attach(context.bus)
        return self._service

    def _display(self, keeper: Keeper) -> Display | None:
        """Return the table on the terminal; it takes the terminal before anything is logged, so that logs go above it."""
        if not sys.stdout.isatty() or self.as_json or self.quiet:
            return None
        view = self.view or View(self.board, f"rtkmesh up {self.site.file.name}")
        view.processes = keeper.rows
        display = Display(view)
        display.start()
        return display

    def _watch(self, display: Display | None) -> None:
        """Take messages, draw, and see whether it is enough (in its own thread: a slow terminal must not hold up control)."""
        if self.prepare is not None:
            self.prepare()
        announcement, next_s = Announcement(), 0.0
        while not self._done.is_set():
            self.board.take(0.1)
            now_s = time.monotonic()
            if now_s >= next_s:
                next_s = now_s + 0.1
                self._end_if_enough()
                announcement.make(self._keeper)
            if display is not None:
                display.refresh(now_s)
        if display is not None:
            display.stop()

    def _end_if_enough(self) -> None:
        if self.reason or self._service is None or (end := self.ends(self)) is None:
            return
        self.reason, self._code = end
        self._service.context.stopping.set()
        self._service.context.inbox.wake()


def _finish(keeper: Keeper, memory: Memory, *, lets_go: bool) -> bool:
    """End the fleet, or leave it to the next control; True when that is done."""
    if lets_go:
        return keeper.let_go()
    if clean := keeper.end():
        memory.end()
    return clean


def never(foreground: Foreground) -> tuple[str, int] | None:
    """End only when told to."""


class AtEnd:
    """End when every solver (without solvers: every receiver) has said that its recordings are at their end, and attitudes came to rest.

    A solver that began anew after its receivers had sent everything will never say so: then it ends as failed.
    """

    def __init__(self, site: Site) -> None:
        self._receivers = {id_ for id_, table in site.deployment.ingest.items() if table.source.startswith("file:")}
        self._waited = set(site.deployment.solver) or self._receivers
        self._attitudes = set(site.deployment.attitude)
        self._at_rest: dict[str, tuple[int, int]] = {}
        self._done, self._idle_since_s = -1, 0.0

    def __call__(self, foreground: Foreground) -> tuple[str, int] | None:
        """Return (why, exit code) when it is the end."""
        for row in foreground.processes():
            if row["state"] == ProcessState.FAILED:
                return f"{row['role']} {row['id']} FAILED: {row['reason']}", EXIT_FAILED
        for id_ in self._receivers & set(foreground.board.statuses):
            status, _ = foreground.board.statuses[id_]
            if any(row.state == "error" for row in status.inputs):
                return f"ingest {id_}: {status.reason}", EXIT_FAILED
        ended = {id_ for id_, (status, _) in foreground.board.statuses.items() if status.data.get("end")}
        if self._waited <= ended:
            rests = self._are_at_rest(foreground.board) or self._idle_s(foreground.board) > _IDLE_S
            return ("all recordings are at their end", 0) if rests else None
        if self._receivers and self._receivers <= ended and self._idle_s(foreground.board) > _IDLE_S:
            return f"all recordings are at their end, but {', '.join(sorted(self._waited - ended))} did not finish", EXIT_FAILED
        return None

    def _are_at_rest(self, board: Board) -> bool:
        """Return whether every attitude has told twice since the end that it has taken as many messages, and all of them."""
        statuses, resting = self._attitude_statuses(board), 0
        for status in statuses:
            taken = _taken(status)
            heartbeat, before = self._at_rest.setdefault(status.id, (status.heartbeat, -1))
            if before != taken:
                self._at_rest[status.id] = status.heartbeat, taken
            resting += before == taken and status.heartbeat >= heartbeat + 2
        return resting == len(statuses)

    def _idle_s(self, board: Board) -> float:
        """Return how long no solution has come, and no attitude has taken any, since all receivers ended."""
        solved, now_s = sum(track.count for track in board.solutions.values()), time.monotonic()
        done = solved + sum(map(_taken, self._attitude_statuses(board)))
        if done != self._done:
            self._done, self._idle_since_s = done, now_s
        return now_s - self._idle_since_s

    def _attitude_statuses(self, board: Board) -> list[ServiceStatus]:
        return [board.statuses[id_][0] for id_ in self._attitudes & set(board.statuses)]


def _taken(status: ServiceStatus) -> int:
    return sum(row.messages for row in status.inputs)


def connect(site: Site, keeper: Keeper) -> Bus:
    """Return the bus when the hub is there; BusError when it has failed."""
    from rtkmesh_services.runtime.zenoh_bus import open_bus

    table = site.deployment.deployment
    endpoints = endpoints_for(table.connect, site.deployment.hub.listen)
    waiting = False
    while True:
        try:
            return open_bus(CONTROL_ID, endpoints, namespace=table.namespace, timeout_s=_CONNECT_S)
        except UnreachableError as error:
            if keeper.state_of(HUB_ID) is ProcessState.FAILED:
                lines = keeper.last_lines(HUB_ID, 1)
                raise BusError(f"the hub does not run: {lines[0] if lines else 'see its log'}") from None
            if not site.deployment.hub.enabled and not waiting:
                waiting = True
                logging.getLogger("rtkmesh").warning("%s; waiting for it", error)


def require_free(site: Site) -> None:
    """BusError when the hub could not listen: somebody has its port."""
    for endpoint in site.deployment.hub.listen if site.deployment.hub.enabled else ():
        if not is_free(endpoint):
            who = port_holder(endpoint) or "does another rtkmesh run here?"
            raise BusError(f"{endpoint} is taken: {who} ([hub] listen names another port)")


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON line."""
    sys.stdout.write(json.dumps(value, default=str) + "\n")
    sys.stdout.flush()


app = command_page(
    up,
    """
    rtkmesh up config/demo.toml
    rtkmesh up robot.toml --detach
    rtkmesh up config/replay_ubx.toml --data ../shared/data
    rtkmesh up config/replay_ubx.toml --data ../shared/data --speed max --exit-at-end
    """,
)
