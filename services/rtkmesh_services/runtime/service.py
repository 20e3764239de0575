"""What every process is made of: a ``Service`` and its ``Context``. This page is all that a role needs to know.

A role's package has ``service.py`` with ``create(context: Context) -> Service``; ``rtkmesh run ROLE --id ID --config FILE``
finds it by that name; with ``preload() -> None`` beside it, what all processes of a role load is loaded once by ``rtkmesh up``
(in a process without threads that they are forked from). One thread, the work loop, calls all hooks except ``warm``:

    class Solver(Service):
        role = Role.SOLVER
        operations = {"start": "begin with a fresh filter", "stop": "no more solutions"}

        def warm(self):                  # in a helper thread, state WARMING: import the engine, compile kernels
        def open(self):                  # then in the loop: subscribe, start sources
            self.context.subscribe(OBS.key("rover"), lane="rover")
            self.context.subscribe(EPH.key("rover", satellite="*"), lane="rover", history=True)
        def handle(self, item):          # one item of the inbox: a bus Sample, or what own threads put there
            self.context.bus.publish(SOL, message)
        def tick(self, now_mono_ns):     # at least every ``tick_s``, and at ``due_mono_ns()``
        def command(self, request):      # own operations; status, help, config, metrics, log, shutdown are served already
            return accepted("started")   # or: raise CommandError(Code.WRONG_STATE, "already running")
        def report(self):                # cheap: called at every tick; figures are computed only when published
            return Report(inputs=[...], counters={...}, latencies={"solve": self._solve_ms})
        def close(self):                 # stop own threads and devices

Sources of a role run in daemon threads of its own that put items into ``context.inbox`` (``put`` never blocks, ``put_wait``
paces a replay) and end when ``context.stopping`` is set. An exception out of a hook or a thread ends the process with code
70, for the supervisor to restart. Tests run the same object with ``runtime.lifecycle.Lifecycle`` step by step on a
``MemoryBus`` with a ``ManualClock``.
"""

import itertools
import logging
import threading
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any, ClassVar

from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.keys import EVENT, Role
from rtkmesh_schemas.status import Event, InputStatus, Level, Quantiles, ServiceStatus, State
from rtkmesh_services.runtime.bus import Bus, Handle, Sample
from rtkmesh_services.runtime.clock import Clock
from rtkmesh_services.runtime.faults import Fault, Faults, time_of_utc
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.statistics import RollingQuantiles

_LEVELS = {Level.DEBUG: logging.DEBUG, Level.INFO: logging.INFO, Level.WARNING: logging.WARNING, Level.ERROR: logging.ERROR}


def new_start_id() -> str:
    """Return a name for one run of one process: consumers see by it that a sequence began anew."""
    return uuid.uuid4().hex[:12]


@dataclass(frozen=True, kw_only=True)
class Context:
    """What the runtime gives to a service. ``stopping`` is set when the process is to end.

    ``running``: control replaces a process that commands had started or stopped; None: it is as its table says.
    """

    id: str
    role: Role
    deployment: Deployment
    bus: Bus
    clock: Clock = field(default_factory=Clock)
    inbox: Inbox = field(default_factory=Inbox)
    log: logging.Logger = field(default_factory=lambda: logging.getLogger("rtkmesh"))
    start_id: str = field(default_factory=new_start_id)
    config_file: Path = Path()
    config_folder: Path = Path()
    config_hash: str = ""
    data_folder: Path | None = None
    running: bool | None = None
    stopping: threading.Event = field(default_factory=threading.Event)
    faults: Faults = field(default_factory=Faults)
    _events: Iterator[int] = field(default_factory=itertools.count)

    def subscribe(self, expression: str, *, lane: str = "stream", history: bool = False, latest: bool = False) -> Handle:
        """Let messages that match come into the inbox as ``Sample``, by ``lane``; ``latest`` keeps only the newest of each key.

        Messages of one sender come in its order, also over several subscriptions.
        """

        def hand_over(sample: Sample) -> None:
            self.inbox.put(sample, lane=lane, key=sample.key if latest else None)

        return self.bus.subscribe(expression, hand_over, history=history)

    def event(self, level: Level, code: str, text: str, *, logged: bool = True, **data: Any) -> None:
        """Publish that something happened (a stable ``code`` for programs, ``text`` for people) and log it. From any thread.

        ``logged`` False: the log says it already, as a change of state or in another process.
        """
        self.log.log(_LEVELS[level] if logged else logging.DEBUG, "%s", text, extra={"fields": {"code": code, **data}})
        event = Event(
            id=self.id,
            level=level,
            code=code,
            text=text,
            sequence=next(self._events),
            utc_ns=self.clock.utc_ns(),
            mono_ns=self.clock.mono_ns(),
            data=data,
        )
        if level in (Level.WARNING, Level.ERROR):
            self.faults.add(Fault(time_of_utc(event.utc_ns), level.value, code, text))
        self.bus.publish(EVENT, event, level=level.value)

    def wait(self, seconds: float) -> bool:
        """Sleep in a thread of a source, but not beyond the process's end; return True when it is to end."""
        return self.stopping.wait(seconds)


@dataclass(frozen=True, kw_only=True)
class Report:
    """How a service is. ``state`` is RUNNING unless it says DEGRADED, STALE or STOPPED, with ``reason``."""

    state: State = State.RUNNING
    reason: str = ""
    inputs: Sequence[InputStatus] = ()
    counters: Mapping[str, int] = field(default_factory=dict[str, int])
    latencies: Mapping[str, RollingQuantiles | Quantiles] = field(default_factory=dict[str, RollingQuantiles | Quantiles])
    last_epoch: tuple[int, float] | None = None
    data: Mapping[str, Any] = field(default_factory=dict[str, Any])


class Service(ABC):
    """One role's behaviour. All hooks but ``handle`` have a quiet default; see the page's top for who calls them."""

    role: ClassVar[Role]
    tick_s: ClassVar[float] = 0.1
    operations: ClassVar[Mapping[str, str]] = {}
    reads: ClassVar[frozenset[str]] = frozenset()  # those of them that change nothing: they are no events

    def __init__(self, context: Context) -> None:
        self.context = context

    def warm(self) -> None:  # noqa: B027  a quiet default
        """Do the slow things (imports, compilation) while the loop already answers. In a helper thread, before ``open``."""

    def open(self) -> None:  # noqa: B027  a quiet default
        """Subscribe and start sources. In the loop; after it the process is declared alive."""

    @abstractmethod
    def handle(self, item: Any) -> None:
        """Take one item of the inbox."""

    def tick(self, now_mono_ns: int) -> None:  # noqa: B027  a quiet default
        """Do what time asks for; called at least every ``tick_s``, and at ``due_mono_ns()``."""

    def due_mono_ns(self) -> float:
        """Return the instant at which ``tick`` is wanted before its turn; inf: at none. Called after every item."""
        return inf

    def command(self, request: Request) -> Reply:
        """Do one of ``operations`` (others do not come here). CommandError becomes an error reply."""
        raise NotImplementedError(f"{type(self).__name__} lists {request.op!r} and does not do it")

    def table(self) -> Any:
        """Return the service's present table of the deployment file."""
        tables: Any = getattr(self.context.deployment, self.context.role.value, {})
        return tables.get(self.context.id) if isinstance(tables, dict) else tables  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]  a role's tables are Any here

    def status_screen(self, status: ServiceStatus) -> tuple[str, dict[str, Any]]:  # noqa: ARG002  a quiet default
        """Return what RTKRCV's console shows for ``status``, and what it tells beside the status itself."""
        return "", {}

    def report(self) -> Report:
        """Return how the service is; cheap."""
        return Report()

    def close(self) -> None:  # noqa: B027  a quiet default
        """Let go of devices and threads; at most a second."""


CreateService = Callable[[Context], Service]


def done(message: str = "", **data: Any) -> Reply:
    """Return the reply of a command that is done. The lifecycle adds id, state and request id."""
    return Reply(ok=True, code=Code.OK, message=message, data=data)


def accepted(message: str = "", **data: Any) -> Reply:
    """Return the reply of a command whose work goes on; its end will be told by status or event."""
    return Reply(ok=True, code=Code.ACCEPTED, message=message, data=data)


def refused(code: Code, message: str, **data: Any) -> Reply:
    """Return the reply of a command that cannot be done."""
    return Reply(ok=False, code=code, message=message, data=data)
