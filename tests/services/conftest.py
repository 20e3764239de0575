"""A hub and processes of the runtime's own tests, over real Zenoh on a free loopback port."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.patience import PATIENCE_S

from rtkmesh_schemas.keys import STATUS
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.control.endpoints import free_port as free_loopback_port
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.state_files import STATE_VARIABLE
from rtkmesh_services.runtime.zenoh_bus import ZenohBus, open_bus

if TYPE_CHECKING:
    from tests.services.flockwave_world import SkybrushClient, World
    from tests.services.told_solver import Solver

UNDER_TEST = Path(__file__).parent / "process_under_test.py"


@dataclass
class Fleet:
    """The processes of one test; all are killed at its end."""

    folder: Path
    namespace: str = ""
    port: int = field(default_factory=free_loopback_port)
    running: list[subprocess.Popen[str]] = field(default_factory=list)
    under_test: Path = UNDER_TEST

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    @property
    def config(self) -> Path:
        path = self.folder / "site.toml"
        if not path.exists():
            path.write_text(f'[deployment]\nnamespace = "{self.namespace}"\n[hub]\nlisten = ["{self.endpoint}"]\n')
        return path

    def start(self, *argv: str, environment: dict[str, str] | None = None) -> subprocess.Popen[str]:
        """Start a program of ours; its stderr is read by ``ended``."""
        process = subprocess.Popen(
            [sys.executable, *argv],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **(environment or {})},
        )
        self.running.append(process)
        return process

    def rtkmesh(self, *arguments: str) -> subprocess.Popen[str]:
        """Start ``rtkmesh`` with arguments."""
        return self.start("-m", "rtkmesh_services.cli.main", *arguments)

    def hub(self) -> subprocess.Popen[str]:
        """Start the hub and wait until it is alive."""
        process = self.rtkmesh("run", "hub", "--config", str(self.config))
        self.until(lambda: self._listens() or process.poll() is not None)
        assert process.poll() is None, process.communicate()
        with self.bus() as bus:
            self.until(lambda: "hub" in bus.live())
        return process

    def process(self, name: str, *arguments: str, environment: dict[str, str] | None = None) -> subprocess.Popen[str]:
        """Start the process under test."""
        return self.start(str(UNDER_TEST), str(self.config), name, *arguments, environment=environment)

    def bus(self, name: str = "test") -> ZenohBus:
        """Return a bus to the hub."""
        return open_bus(name, [self.endpoint], namespace=self.namespace, timeout_s=PATIENCE_S)

    def _listens(self) -> bool:
        with socket.socket() as probe:
            probe.settimeout(1.0)
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def until(self, condition: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
        """Return as soon as the condition holds; fail when it does not within the time."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            time.sleep(0.01)

    def status_until(
        self, bus: ZenohBus, name: str, condition: Callable[[ServiceStatus], bool], timeout_s: float = PATIENCE_S
    ) -> ServiceStatus:
        """Return the first status of a process that fulfils the condition."""
        inbox = Inbox()
        handle = bus.subscribe(STATUS.key(name), inbox.put, history=True)
        deadline = time.monotonic() + timeout_s
        try:
            while (left := deadline - time.monotonic()) > 0.0:
                sample = inbox.get(left)
                if sample is not None and condition(status := decode(ServiceStatus, sample.payload, sample.encoding)):
                    return status
        finally:
            handle.close()
        raise AssertionError(f"{name} was never so")

    def is_running(self, bus: ZenohBus, name: str) -> ServiceStatus:
        """Wait until a process is RUNNING."""
        return self.status_until(bus, name, lambda status: status.state is State.RUNNING)

    def kill(self) -> None:
        """End all, whatever state they are in."""
        for process in self.running:
            with suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
            process.kill()
            process.communicate()


@pytest.fixture(autouse=True)
def patient_writers(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a test's own process files may be written out for as long as the machine wants: nobody cuts it off after two seconds."""
    for module in ("recorder.service", "output.files"):
        monkeypatch.setattr(f"rtkmesh_services.{module}.CLOSE_S", PATIENCE_S)


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    """Processes and a free port; nothing of it is left afterwards."""
    fleet = Fleet(tmp_path)
    yield fleet
    fleet.kill()


@pytest.fixture(scope="module")
def hub_port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a hub that the tests of a module share."""
    shared = Fleet(tmp_path_factory.mktemp("hub"))
    shared.hub()
    yield shared.port
    shared.kill()


@pytest.fixture
def site(tmp_path: Path, hub_port: int) -> Iterator[Fleet]:
    """Processes of one test at the shared hub."""
    fleet = Fleet(tmp_path, port=hub_port)
    yield fleet
    fleet.kill()


@pytest.fixture
def solver(site: Fleet) -> Iterator["Solver"]:
    """A solver that answers with RTKRCV's texts, and is on the network."""
    from tests.services.told_solver import Solver

    made = Solver(site)
    with site.bus("waiter") as bus:
        site.until(lambda: "rtk" in bus.live())
    yield made
    made.close()


@pytest.fixture(scope="session")
def free_port() -> Callable[[], int]:
    """A function that returns a loopback port that nobody listens on."""
    return free_loopback_port


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of a quarter of a megabyte."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "rtkmesh-test", str(folder)], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip(f"cannot mount a tmpfs: {mounted.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator["World"]:
    """Control with Flockwave and two bases, on a clock that stands still."""
    from tests.services.flockwave_world import World

    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    with closing(World(tmp_path)) as world:
        yield world


@pytest.fixture
def client(world: "World") -> Iterator["SkybrushClient"]:
    """A Skybrush client of that world, by TCP."""
    from tests.services.flockwave_world import SkybrushClient

    with closing(SkybrushClient(world)) as client:
        yield client
