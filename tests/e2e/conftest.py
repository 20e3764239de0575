"""Running deployments of real processes on a port of their own, and never leaving one behind."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from tests.patience import PATIENCE_S

from rtkmesh_schemas.command import Reply
from rtkmesh_schemas.keys import SOL, STATUS
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.runtime.bus import Bus, Sample
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.zenoh_bus import open_bus

FIX = 1
POLL_S = 0.02  # other processes are polled: there is nothing of ours to wait on


@pytest.fixture(scope="session")
def compiled() -> None:
    """The kernels are compiled before the clock of a test runs."""
    subprocess.run([sys.executable, "-m", "rtkmesh_services.cli.main", "warm"], check=True, capture_output=True, timeout=280)


class Network:
    """A bus to the processes of a deployment, and all that stem from its start: they inherit its mark."""

    def __init__(self, endpoint: str, environment: dict[str, str] | None = None) -> None:
        self.endpoint = endpoint
        self._mark = f"RTKMESH_TEST={uuid.uuid4().hex}"
        name, _, value = self._mark.partition("=")
        self.environment = {**os.environ, **(environment or {}), name: value}
        self._bus: Bus | None = None

    @property
    def bus(self) -> Bus:
        if self._bus is None:
            self._bus = open_bus(f"test_{os.getpid()}", [self.endpoint], timeout_s=PATIENCE_S)
        return self._bus

    def statuses(self) -> dict[str, ServiceStatus]:
        """Return the newest status of every process; what is returned goes on being filled."""
        found: dict[str, ServiceStatus] = {}

        def take(sample: Sample) -> None:
            status = decode(ServiceStatus, sample.payload, sample.encoding)
            found[status.id] = status

        self.bus.subscribe(STATUS.key("*"), take, history=True)
        return found

    def fixes(self, solver: str) -> list[SolutionMessage]:
        """Return the fixes of a solver from now on; what is returned goes on being filled."""
        found: list[SolutionMessage] = []

        def take(sample: Sample) -> None:
            message = decode(SolutionMessage, sample.payload, sample.encoding)
            if message.status == FIX:
                found.append(message)

        self.bus.subscribe(SOL.key(solver), take)
        return found

    def ask(self, id_: str, op: str, **args: Any) -> Reply:
        return call(self.bus, id_, op, args, 15.0)[0]

    def rows(self) -> dict[str, dict[str, Any]]:
        reply = self.ask("control", "status")
        found: list[dict[str, Any]] = reply.data.get("data", {}).get("processes", []) if reply.ok else []
        return {row["id"]: row for row in found}

    def all_running(self) -> dict[str, dict[str, Any]] | None:
        rows = self.rows()
        return rows if rows and all(row["state"] == "RUNNING" for row in rows.values()) else None

    def left(self) -> list[int]:
        """Return the processes that stem from this deployment and are still there."""
        pids = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]
        return [pid for pid in pids if is_running(pid) and self._mark in environment_of(pid)]

    def until(self, what: Callable[[], Any], timeout_s: float = PATIENCE_S) -> Any:
        """Wait until ``what`` is true; return what it gave."""
        deadline = time.monotonic() + timeout_s
        while not (found := what()):
            self.check()
            assert time.monotonic() < deadline, f"not in {timeout_s} s: {self.text()}"
            time.sleep(POLL_S)
        return found

    def check(self) -> None:
        """Fail when it cannot come to a good end any more."""

    def text(self) -> str:
        """Return what helps to see why a test failed."""
        return ""

    def kill_left(self) -> None:
        """Leave nothing: a failed test must not disturb the next one."""
        if self._bus is not None:
            self._bus.close()
        while pids := self.left():  # a control among them may start others until it is gone
            for pid in pids:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)


class Deployment(Network):
    """A running ``rtkmesh up`` (or ``demo``): its JSON lines, a bus to it, its processes."""

    def __init__(self, command: list[str], endpoint: str, environment: dict[str, str] | None = None) -> None:
        super().__init__(endpoint, environment)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rtkmesh_services.cli.main", *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=self.environment,
        )
        self.events: list[dict[str, Any]] = []
        self.log: list[str] = []
        self._readers = [threading.Thread(target=self._read_events, daemon=True), threading.Thread(target=self._read_log, daemon=True)]
        for reader in self._readers:
            reader.start()

    def check(self) -> None:
        assert self.process.poll() is None, f"it ended with {self.process.returncode}: {self.text()}"

    def interrupt(self, number: int = signal.SIGINT, timeout_s: float = PATIENCE_S) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        return self.wait(timeout_s)

    def wait(self, timeout_s: float) -> int:
        """Return the exit code when it has ended by itself; all of its output is read then."""
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"it does not end: {self.text()}")
        for reader in self._readers:
            reader.join(PATIENCE_S)
        return code

    def left(self) -> list[int]:
        return [pid for pid in super().left() if pid != self.process.pid]

    def text(self) -> str:
        return "\n".join([*map(str, self.events[-10:]), *self.log[-80:]])

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.wait(PATIENCE_S)
        self.kill_left()

    def _read_events(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                event = json.loads(line) if line.startswith(b"{") else {"event": "text", "text": line.decode()}
                self.events.append(event)

    def _read_log(self) -> None:
        assert self.process.stderr is not None
        with self.process.stderr as lines:
            self.log.extend(line.decode(errors="replace").rstrip() for line in lines)


def is_running(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def environment_of(pid: int) -> list[str]:
    """Return the environment that a process was started with; nothing if it has just gone."""
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().decode(errors="replace").split("\0")
    except (FileNotFoundError, ProcessLookupError, PermissionError):
        return []


def free_besides(*taken: int) -> int:
    """Return a loopback port that is free now and none of these."""
    while True:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            found: int = probe.getsockname()[1]
            if found not in taken:
                return found


@pytest.fixture
def port() -> int:
    """A loopback port that is free now."""
    return free_besides()


@pytest.fixture
def free(port: int) -> int:
    """A second free port."""
    return free_besides(port)


@pytest.fixture
def up(tmp_path: Path, port: int) -> Iterator[Callable[..., Deployment]]:
    """A function that runs ``rtkmesh up`` on a deployment text (its [hub] is added) and ends it after the test."""
    made: list[Deployment] = []

    def start(text: str, *arguments: str, **environment: str) -> Deployment:
        file = tmp_path / f"deployment{len(made)}.toml"
        file.write_text(f'[hub]\nlisten = ["tcp/127.0.0.1:{port}"]\n{text}')
        kept = {"RTKMESH_STATE": str(tmp_path / "state"), **environment}  # nothing of this host's, and nothing for it
        made.append(Deployment(["up", str(file), "--json", *arguments], f"tcp/127.0.0.1:{port}", kept))
        return made[-1]

    yield start
    for deployment in made:
        deployment.close()
