"""Control's side of the fork server: a process that has loaded the engine and becomes ingests, solvers and attitudes by forking.

What they have in common, a compiler's library and the engine's kernels, is then in memory once, and a process that died is back
without loading it. A fork server that is late, missing or dead changes nothing but that: processes are then started as programs.
"""

import contextlib
import ctypes
import json
import logging
import os
import selectors
import socket
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from select import select
from typing import IO, Any, Final

from rtkmesh_schemas.keys import Role
from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.control.process import PARENT_VARIABLE, environment_of
from rtkmesh_services.runtime.log_files import open_log

PATIENCE_S: Final = 10.0  # how long processes are held for it; a first start that compiles takes longer
RETRY_S: Final = 10.0
ANSWER_S: Final = 5.0
REQUEST_BYTES: Final = 65536
FORKED: Final = (Role.INGEST, Role.SOLVER, Role.ATTITUDE)
TITLE_BYTES: Final = 240  # of a process's name in `ps`: room in the server's arguments that its children write over
MODULE: Final = "rtkmesh_services.cli.fork_server"
_PR_SET_CHILD_SUBREAPER: Final = 36
_log = logging.getLogger("rtkmesh.control")


@dataclass(frozen=True, slots=True)
class Forked:
    """A process that the server forked and that has become our child."""

    pid: int
    stdout: IO[bytes] | None = None
    stderr: IO[bytes] | None = None

    def wait(self) -> int:
        """Wait for its end; return its exit code, negative for a signal."""
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


class ForkServer:
    """Starts the server and asks it for processes. All methods belong to the keeper's thread: the server dies with it.

    ``ready``: the roles whose processes it forks.
    """

    def __init__(self, roles: tuple[Role, ...], environment: Mapping[str, str]) -> None:
        self._roles, self._environment = roles, environment
        self._selector: selectors.BaseSelector | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self.ready: frozenset[Role] = frozenset()
        self._patient_until_s = self._retry_at_s = 0.0
        self._begun = False

    def tend(self, now_s: float, selector: selectors.BaseSelector) -> None:
        """Start the server if it is not there, and let the selector wait for what it says: then ``read``."""
        if self._socket is not None or now_s < self._retry_at_s:
            return
        self._selector = selector
        self._retry_at_s = now_s + RETRY_S
        if not self._begun:
            self._begun, self._patient_until_s = True, now_s + PATIENCE_S
        try:
            self._begin()
        except OSError as error:
            _log.warning("no fork server: %s", error)
            self._lose()

    def held(self, now_s: float) -> frozenset[Role]:
        """Return the roles whose processes are to wait for the server."""
        waiting = self._socket is not None and now_s < self._patient_until_s
        return frozenset(self._roles if waiting else ())

    def read(self) -> None:
        """Take what the server says."""
        while self._socket is not None and select([self._socket], [], [], 0.0)[0]:
            if (message := self._receive()) is not None:
                self._take(message)

    def start(self, spec: ProcessSpec) -> Forked | None:
        """Return a forked process, or None: start it as a program."""
        self.read()
        if self._socket is None or spec.role not in self.ready or spec.argv[0] != sys.executable:
            return None
        reads, writes = _outputs(spec)
        try:
            request = json.dumps({"argv": spec.argv[3:], "environment": environment_of(spec)}).encode()
            socket.send_fds(self._socket, [request], writes)
            pid = self._answer()
        except OSError as error:
            _log.warning("the fork server does not answer: %s", error)
            self._lose()
            pid = 0
        for write in writes:
            os.close(write)
        if pid:
            return Forked(pid, *(os.fdopen(read, "rb", buffering=0) for read in reads))
        for read in reads:
            os.close(read)
        return None

    def close(self) -> None:
        """End the server; what it has forked is not touched."""
        self._roles = ()
        self._lose()

    def _begin(self) -> None:
        adopt_orphans()
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWER_S)
        if self._selector is not None:
            self._selector.register(self._socket, selectors.EVENT_READ, self)
        with theirs:
            argv = [sys.executable, "-m", MODULE, str(theirs.fileno()), *self._roles]
            self._process = subprocess.Popen(
                [*argv, "." * max(1, TITLE_BYTES - len(" ".join(argv)))],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=dict(self._environment) | {PARENT_VARIABLE: str(os.getpid())},
                pass_fds=(theirs.fileno(),),
                start_new_session=True,
            )

    def _receive(self) -> dict[str, Any] | None:
        """Return what the server says next; None when it has gone, or says nothing for too long."""
        assert self._socket is not None, "asked only while it is there"
        try:
            data = self._socket.recv(REQUEST_BYTES)
        except OSError:
            data = b""
        if not data:
            self._lose()
            return None
        message: dict[str, Any] = json.loads(data)
        return message

    def _answer(self) -> int:
        while (message := self._receive()) is not None:
            if "pid" in message:
                return int(message["pid"])
            self._take(message)
        return 0

    def _take(self, message: dict[str, Any]) -> None:
        if "ready" in message:
            self.ready = frozenset(Role(name) for name in message["ready"])
            self._patient_until_s = 0.0
        elif "error" in message:
            _log.warning("fork server: %s", message["error"])

    def _lose(self) -> None:
        self.ready = frozenset()
        if self._socket is not None:
            if self._selector is not None:
                self._selector.unregister(self._socket)
            self._socket.close()
            self._socket = None
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
            self._process.wait()
            self._process = None


def _outputs(spec: ProcessSpec) -> tuple[list[int], list[int]]:
    """Return (our ends, its ends) of a process's output and error output: pipes, or a log file that nobody has to read."""
    if spec.log_file is not None:
        log = open_log(spec.log_file)
        return [], [log, os.dup(log)]
    pipes = [os.pipe2(os.O_CLOEXEC) for _ in range(2)]
    return [read for read, _ in pipes], [write for _, write in pipes]


def adopt_orphans() -> None:
    """Become the parent of processes whose own parent ends, or OSError: so a forked process is our child, like one that we start."""
    if not sys.platform.startswith("linux") or ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        raise OSError("orphans cannot be adopted here")
