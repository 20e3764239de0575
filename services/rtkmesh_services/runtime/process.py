"""The process around a service: signals, deadline of its end, uncaught exceptions, death of the parent, exit codes.

Exit codes: 0 asked to end, 2 the site is at fault (configuration, busy address), 70 an uncaught exception, 75 the end took
too long and was cut. A signal is read from a pipe by a watching thread, so it works while the main thread is inside C code.
"""

import contextlib
import ctypes
import faulthandler
import gc
import logging
import os
import queue
import signal
import socket
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Final, NoReturn

from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.keys import Role
from rtkmesh_schemas.status import Level
from rtkmesh_services.errors import ServiceError, StoppedError
from rtkmesh_services.runtime.bus import Bus
from rtkmesh_services.runtime.configuration import Site
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.log_files import bound_own_output
from rtkmesh_services.runtime.logs import BusHandler, configure
from rtkmesh_services.runtime.service import Context, CreateService

EXIT_OK: Final = 0
EXIT_SITE: Final = 2
EXIT_CRASHED: Final = 70
EXIT_CUT: Final = 75
END_S: Final = 1.5
SWITCH_S: Final = 0.0005  # Zenoh's callbacks wait for the interpreter that long behind a busy loop (Python's 5 ms: p50 11 ms, now 1 ms)
PARENT_VARIABLE: Final = "RTKMESH_PARENT"
RUNNING_VARIABLE: Final = "RTKMESH_RUNNING"  # 1 or 0: what the process that we replace had been told last
_PR_SET_PDEATHSIG: Final = 1
_ENDING: Final = frozenset({signal.SIGTERM, signal.SIGINT})

_log = logging.getLogger(__name__)


def run_service(
    create: CreateService,
    *,
    role: Role,
    id: str,  # noqa: A002  the word of the design
    site: Site,
    open_bus: Callable[[], Bus],
    end_s: float = END_S,
) -> int:
    """Run one service until it is told to end; return the exit code. Call from the main thread, and leave with ``leave``.

    The process is cut off ``end_s`` after it was told to end (longer for a parent that ends its children first).
    """
    log = configure(id, role.value, site.deployment.deployment.log_level)
    guard = Guard(end_s)
    bound_own_output()
    sys.setswitchinterval(SWITCH_S)
    follow_parent()
    try:
        bus = _open(open_bus, guard)
    except StoppedError:
        return EXIT_OK
    except ServiceError as error:
        log.error("%s", error)
        return EXIT_SITE
    logging.getLogger().addHandler(BusHandler(bus, role.value))
    context = Context(
        id=id,
        role=role,
        deployment=site.deployment,
        bus=bus,
        log=log,
        inbox=Inbox(),
        config_file=site.file,
        config_folder=site.folder,
        config_hash=site.hash,
        data_folder=site.data_folder,
        running={"0": False, "1": True}.get(os.environ.get(RUNNING_VARIABLE, "")),
    )
    return _live(create, context, guard)


def _live(create: CreateService, context: Context, guard: "Guard") -> int:
    lifecycle: Lifecycle | None = None
    error: BaseException | None = None
    try:
        lifecycle = Lifecycle(create(context), on_open=gc.freeze)  # what is loaded by now stays: a full collection took 30 ms of it
        guard.watch(lifecycle.end)
        lifecycle.start()
        while not lifecycle.ended and guard.crash is None:
            lifecycle.step()
        error = guard.crash
    except BaseException as caught:  # noqa: BLE001  the last boundary: reported, then the process ends
        error = caught
    guard.arm()
    code = _report_end(context, error)
    try:
        if lifecycle is not None:
            lifecycle.finish(error=error)
    except BaseException:  # noqa: BLE001  as above
        _log.exception("closing failed")
        code = code or EXIT_CRASHED
    context.bus.close()
    return code


def _report_end(context: Context, error: BaseException | None) -> int:
    if error is None:
        return EXIT_OK
    if isinstance(error, (ServiceError, SchemaError)):  # the fault of the site: a trace of ours would only hide it
        context.event(Level.ERROR, "site_fault", str(error))
        return EXIT_SITE
    context.log.error("uncaught: %s", error, exc_info=error)
    context.event(Level.ERROR, "crashed", f"{type(error).__name__}: {error}")
    return EXIT_CRASHED


def _open(open_bus: Callable[[], Bus], guard: "Guard") -> Bus:
    """Open the bus in a thread (it may wait for the hub for ever); StoppedError when told to end before."""
    outcome: queue.SimpleQueue[Bus | BaseException] = queue.SimpleQueue()

    def opening() -> None:
        try:
            outcome.put(open_bus())
        except BaseException as error:  # noqa: BLE001  raised again by the waiting thread
            outcome.put(error)

    guard.watch(lambda reason: outcome.put(StoppedError(reason)))
    threading.Thread(target=opening, name="open-bus", daemon=True).start()
    result = outcome.get()
    if isinstance(result, BaseException):
        raise result
    return result


class Guard:
    """Watches for signals, crashed threads and an end that takes too long. One per process, made in the main thread."""

    def __init__(self, end_s: float = END_S) -> None:
        self._end_s = end_s
        self.crash: BaseException | None = None
        self._on_end: Callable[[str], None] | None = None
        self._pending = ""
        self._lock = threading.Lock()
        self._armed = threading.Event()
        self._read, self._write = socket.socketpair()
        self._write.setblocking(False)
        faulthandler.enable()
        for number in _ENDING:
            signal.signal(number, _noted)
        signal.set_wakeup_fd(self._write.fileno(), warn_on_full_buffer=False)
        threading.excepthook = self._thread_crashed
        threading.Thread(target=self._watch_signals, name="signals", daemon=True).start()
        threading.Thread(target=self._watch_end, name="deadline", daemon=True).start()

    def watch(self, on_end: Callable[[str], None]) -> None:
        """Tell ``on_end`` why the process is to end, from now on, and at once if that was said before."""
        with self._lock:
            self._on_end = on_end
            pending = self._pending
        if pending:
            on_end(pending)

    def arm(self) -> None:
        """Begin the last seconds: the process is cut off when it is still there after them."""
        self._armed.set()

    def _end(self, reason: str) -> None:
        with self._lock:
            self._pending = reason
            on_end = self._on_end
        self.arm()
        if on_end is not None:
            on_end(reason)

    def _watch_signals(self) -> None:
        while data := self._read.recv(64):
            for number in data:
                if number in _ENDING:
                    self._end(signal.Signals(number).name)

    def _watch_end(self) -> None:
        self._armed.wait()
        threading.Event().wait(self._end_s)
        sys.stderr.write("the process did not end in time and is cut off; its threads were at:\n")
        sys.stderr.flush()
        faulthandler.dump_traceback()
        os._exit(EXIT_CUT)

    def _thread_crashed(self, args: threading.ExceptHookArgs) -> None:
        if args.exc_value is None or args.exc_type is SystemExit:
            return
        name = args.thread.name if args.thread else "?"
        _log.error("thread %s crashed", name, exc_info=args.exc_value)
        self.crash = self.crash or args.exc_value
        self._end(f"thread {name} crashed")


def _noted(number: int, frame: FrameType | None) -> None:
    """Take a signal: the pipe of ``signal.set_wakeup_fd`` has already told the guard."""


def follow_parent() -> None:
    """End with the parent when ``RTKMESH_PARENT`` names it: the kernel kills us at its death, so that even a hung one is no orphan."""
    parent = os.environ.get(PARENT_VARIABLE)
    if not parent or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
    if parent.isdecimal() and os.getppid() != int(parent):
        os.kill(os.getpid(), signal.SIGTERM)


def leave(code: int) -> NoReturn:
    """End the process now, without the interpreter's farewell: nothing left behind in a thread can hold it up."""
    with contextlib.suppress(OSError, ValueError):
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)
