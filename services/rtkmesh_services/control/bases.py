"""Base stations of a fleet: which presets run, which solver uses which, and that both become what is wanted.

Nothing is scripted: at each look the processes and the solvers' bases are compared with what is selected, and what differs is asked for. A
solver listens to a new base first and leaves the old one when the new one delivers, so the old one's process ends only when no solver
says any more that it uses it.
"""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rtkmesh_schemas.config import Deployment, SolverTable
from rtkmesh_schemas.presets import Preset, ingest_id
from rtkmesh_schemas.status import Level, ServiceStatus, State
from rtkmesh_services.control.base_choice import Choice
from rtkmesh_services.control.base_ingests import base_spec
from rtkmesh_services.control.base_orders import BaseOrders
from rtkmesh_services.control.base_scores import NOTHING, Score, score
from rtkmesh_services.control.fleet import LaunchOptions
from rtkmesh_services.control.keeper import Keeper
from rtkmesh_services.control.preset_ports import FoundPort, find_ports
from rtkmesh_services.control.presets import Change, PresetBook
from rtkmesh_services.control.records import ProcessState
from rtkmesh_services.runtime.bus import Handle
from rtkmesh_services.runtime.service import Context
from rtkmesh_services.runtime.state_files import state_folder

LOOK_S: Final = 0.2
HEARD_S: Final = 4.0  # by then all that run have said which base they use
PORTS_S: Final = 1.0
LANE: Final = "bases"
_NOT_YET: Final = (State.STARTING, State.WARMING)
_WITHOUT_STATION: Final = ("single", "moving-base")


@dataclass(frozen=True, slots=True)
class PortsFound:
    """The serial ports that are plugged in have changed."""

    ports: Mapping[str, FoundPort]


@dataclass(frozen=True, slots=True)
class Heard:
    """A process's newest status and when it came (s)."""

    status: ServiceStatus
    at_s: float


class Bases:
    """Keeps the base stations as they are selected. All in control's work loop but for the watch over ports."""

    def __init__(self, context: Context, keeper: Keeper, options: LaunchOptions, orders: BaseOrders | None = None) -> None:
        self._context, self._keeper, self._options = context, keeper, options
        self._deployment: Deployment = context.deployment
        self.book = PresetBook(self._deployment.preset, state_folder(), self._now_s)
        self._choices: dict[str, Choice] = {}
        self._heard: dict[str, Heard] = {}
        self._running: dict[str, str] = {}  # ingest id: preset
        self._started: dict[str, Preset] = {}  # as the processes know them
        self._scores: dict[str, Score] = {}
        self._keys: dict[str, Handle] = {}
        self._orders = orders or BaseOrders(context, LANE)
        self._next_look_s = self._opened_s = 0.0
        self._on_question: Callable[[str], Handle] | None = None

    def open(self, declare_key: Callable[[str], Handle] | None = None) -> None:
        """Begin. ``declare_key`` makes the key of a preset answered."""
        self._opened_s = self._now_s()
        self._on_question = declare_key
        self.book.on_change(self._changed)
        for name in self.book.ids():
            self._declare(name)
        self._choose_all()
        if self._deployment.bases.hot_plug:
            threading.Thread(target=self._watch_ports, name="ports", daemon=True).start()

    def reload(self, deployment: Deployment) -> None:
        """Take a file that was read again."""
        self._deployment = deployment
        self._started.clear()
        self.book.replace_builtin(deployment.preset)
        self._choices.clear()
        self._choose_all()

    def heard(self, status: ServiceStatus, now_s: float) -> None:
        """Take a status of any process."""
        if status.id in self._running or status.id in self._choices:
            if status.id in self._running and status.id not in self._heard:
                for choice in self._choices.values():
                    choice.started(self._running[status.id], now_s)
            self._heard[status.id] = Heard(status, now_s)

    def took(self, item: Any) -> bool:
        """Take an item of our lane; False when it is another one's."""
        if isinstance(item, PortsFound):
            self.book.ports(item.ports)
            return True
        return self._orders.took(item, self._now_s())

    def tick(self, now_s: float) -> None:
        """Look whether everything is as it is wanted."""
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + LOOK_S
        self._score(now_s)
        for solver, choice in self._choices.items():
            before = choice.active
            if why := choice.update({name: one.value for name, one in self._scores.items()}, now_s):
                self._tell_failover(solver, before or "", choice, why)
        self._keep_processes()
        if now_s >= self._opened_s + HEARD_S:
            self._keeper.end_unclaimed()
        for solver in self._choices:
            self._direct(solver, now_s)

    def solvers(self) -> list[str]:
        """Return the solvers that have a base station."""
        return list(self._choices)

    def state_of(self, preset: Preset) -> dict[str, Any]:
        """Return state, score and users of a preset as plain values."""
        process = ingest_id(preset.id)
        state, reason = self._process_state(process)
        return {
            "selected": preset.id == self.book.selected(),
            "solvers": [solver for solver, choice in self._choices.items() if choice.active == preset.id],
            "used_by": [solver for solver in self._choices if self._used(solver) == process],
            "state": state,
            "reason": reason,
            **self._scores.get(preset.id, NOTHING).words(),
        }

    def data(self) -> dict[str, Any]:
        """Return what control's status tells: the selection, and the score of each preset that runs."""
        running = {name: self._scores.get(name, NOTHING) for name in self._running.values()}
        return {
            "preset": self.book.selected(),
            "bases": {solver: choice.active for solver, choice in self._choices.items()},
            "preset_scores": {name: {"score": round(one.value, 3), "weakest": one.weakest} for name, one in running.items()},
        }

    def close(self) -> None:
        """Ask nobody any more."""
        self._orders.close()

    def _process_state(self, process: str) -> tuple[str, str]:
        """Return state and reason of a preset's process: what it says itself while it runs, nothing where it is not to run."""
        heard = self._heard.get(process)
        row = next((row for row in self._keeper.rows() if row["id"] == process), None) if process in self._running else None
        if row is None:
            return "", ""
        if heard is None or row["state"] != ProcessState.RUNNING:
            return row["state"], row["reason"]
        return heard.status.state.value, heard.status.reason

    # -- what is wanted

    def _choose_all(self) -> None:
        for name, table in self._deployment.solver.items():
            if table.mode not in _WITHOUT_STATION and name not in self._choices:
                self._choices[name] = Choice(self._deployment.bases, table.presets)
                self._choose(name)

    def _choose(self, solver: str) -> None:
        """Let a solver want what is selected for it: by itself, for all, or else the first of its list."""
        names = self._choices[solver].names
        wanted = self.book.selected(solver)
        if wanted is None and names and not self.book.own(solver) and not self.book.chosen:
            wanted = names[0]
        if wanted != next(iter(self._choices[solver].order), None):
            starting = wanted is not None and ingest_id(wanted) not in self._heard
            self._choices[solver].prefer(wanted, self._now_s(), starting=starting)

    def _wanted(self) -> dict[str, Preset]:
        """Return the presets that have to run, by the ids of their processes: selected, wanted and used ones, those on standby.

        What is selected for all runs without any solver too: others may take its frames.
        """
        names = [self.book.selected() or "", *(name for choice in self._choices.values() for name in (*choice.wanted, choice.active or ""))]
        names += [name for name in self.book.ids() if self._on_standby(name)]
        known = {ingest_id(name): name for name in self.book.ids()}  # also of processes that an earlier control has started
        names += [known[used] for solver in self._choices if (used := self._used(solver)) in known]
        return {ingest_id(name): preset for name in dict.fromkeys(names) if (preset := self.book.get(name)) is not None}

    def _on_standby(self, name: str) -> bool:
        preset = self.book.get(name)
        return preset is not None and preset.standby and preset.format != "rtcm2"

    def _used(self, solver: str) -> str:
        """Return the ingest that a solver says it uses as base."""
        heard = self._heard.get(solver)
        return "" if heard is None else str(heard.status.data.get("base", ""))

    # -- what is done for it

    def _keep_processes(self) -> None:
        wanted = self._wanted()
        for process in [process for process in self._running if process not in wanted]:
            self._keeper.dismiss(process)
            self._heard.pop(process, None)
            self._started.pop(process, None)
            self._scores.pop(self._running.pop(process), None)
        for process, preset in wanted.items():
            if self._started.get(process) != preset:
                self._running[process], self._started[process] = preset.id, preset
                self._keeper.include(base_spec(preset, self._deployment, self._options))

    def _direct(self, solver: str, now_s: float) -> None:
        """Ask a solver to use its base, where it uses another one."""
        heard, active = self._heard.get(solver), self._choices[solver].active
        table: SolverTable = self._deployment.solver[solver]
        wanted = table.base if active is None else ingest_id(active)
        if heard is None or heard.status.state in _NOT_YET or str(heard.status.data.get("base", "")) == wanted:
            return
        preset = None if active is None else self.book.get(active)
        antenna = preset.table.antenna if preset is not None else ""
        arguments: dict[str, Any] = {
            "id": wanted,
            "timeout_s": self._deployment.bases.timeout_s,
            **({"antenna": antenna} if antenna else {}),
        }
        delivers = active is None or self._scores.get(active, NOTHING).value > 0.0
        self._orders.ask(solver, arguments, heard.status, now_s, again=delivers)

    def _score(self, now_s: float) -> None:
        place = self._rover_ecef_m()
        for process, name in self._running.items():
            heard = self._heard.get(process)
            self._scores[name] = NOTHING if heard is None else score(heard.status, now_s - heard.at_s, place)

    def _rover_ecef_m(self) -> list[float] | None:
        places = (heard.status.data.get("position_ecef_m") for solver in self._choices if (heard := self._heard.get(solver)) is not None)
        return next((place for place in places if place), None)

    # -- what is told

    def _changed(self, change: Change, name: str, solver: str) -> None:
        """Take a change of the book."""
        if change is Change.PRESETS:
            self._declare(name)
            return
        for one in [solver] if solver else self._choices:
            if one in self._choices:
                self._choose(one)
        self._next_look_s = 0.0
        whom = solver or "all solvers"
        text, level = {
            Change.SELECTED: (f"base preset {name or 'none'} is selected for {whom}", Level.INFO),
            Change.LOST: (f"base preset {name}, selected for {whom}, has vanished: none is selected", Level.WARNING),
            Change.BACK: (f"base preset {name} is back and selected again for {whom}", Level.INFO),
        }[change]
        self._context.event(level, f"preset_{change.value}", text, preset=name, solver=solver)

    def _tell_failover(self, solver: str, before: str, choice: Choice, why: str) -> None:
        first = choice.active == choice.order[0]
        code, level = ("preset_returned", Level.INFO) if first else ("preset_failover", Level.WARNING)
        text = f"{solver} takes base preset {choice.active}, {'which ' if why.startswith('has') else ''}{why}"
        self._context.event(level, code, text, solver=solver, old=before, new=choice.active, scores=self._told_scores(choice))

    def _told_scores(self, choice: Choice) -> dict[str, float]:
        return {name: round(self._scores.get(name, NOTHING).value, 3) for name in choice.order}

    def _declare(self, name: str) -> None:
        there = self.book.get(name) is not None
        if there and name not in self._keys and self._on_question is not None:
            self._keys[name] = self._on_question(name)
        elif not there and name in self._keys:
            self._keys.pop(name).close()

    # -- ports

    def _watch_ports(self) -> None:
        """Look for serial ports again and again (in a thread of its own: the system takes its time)."""
        before: Mapping[str, FoundPort] | None = None
        while not self._context.stopping.is_set():
            found = find_ports(self._deployment.bases, _ports_of(self._deployment))
            if found != before:
                before = found
                self._context.inbox.put(PortsFound(found), lane=LANE)
            self._context.wait(PORTS_S)

    def _now_s(self) -> float:
        return self._context.clock.mono_ns() * 1e-9


def _ports_of(deployment: Deployment) -> list[str]:
    """Return the paths of the serial ports that processes of the file use."""
    sources = [source for table in deployment.ingest.values() for source in (table.source, *table.fallback)]
    return [source.removeprefix("serial://").partition("?")[0] for source in sources if source.startswith("serial:///")]
