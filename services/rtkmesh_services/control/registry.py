"""What control keeps on this host of one deployment: who runs, who shall run, what they write, and who keeps them.

One folder per deployment below the state folder, named by its name, file and namespace. ``rtkmesh ps``, ``logs`` and ``down`` read it,
also when no control is there.
"""

import errno
import fcntl
import hashlib
import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Final, TypeVar

import msgspec

from rtkmesh_schemas.keys import Role
from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.configuration import Site
from rtkmesh_services.runtime.host_processes import Identity, identity_of, is_alive, writers_below
from rtkmesh_services.runtime.state_files import state_folder, write_state

FOLDER: Final = "deployments"
CONTROL_LOG: Final = "control"
_MAXIMUM_FILE: Final = 1 << 22
_LOCK_WAIT_S: Final = 1.0  # a control that is just ending


class HeldError(ServiceError):
    """A deployment has a control already."""


class ProcessEntry(msgspec.Struct, frozen=True, kw_only=True):
    """One process as control last saw it. ``definition``: a hash of all that it was started with."""

    id: str
    role: Role
    definition: str = ""
    identity: Identity | None = None
    start_id: str = ""
    state: str = ""
    reason: str = ""
    restarts: int = 0
    further: bool = False  # it is not of the file: control itself asked for it

    def unwanted_spec(self) -> ProcessSpec:
        """Return what stands for a process that is in the file no more, until it has ended."""
        return ProcessSpec(self.id, self.role, ())


class Running(msgspec.Struct, frozen=True, kw_only=True):
    """The processes of a deployment, its control, and where it is reached. ``outlive``: they run on when control dies."""

    name: str = ""
    file: str = ""
    namespace: str = ""
    endpoints: tuple[str, ...] = ()
    outlive: bool = False
    control: Identity | None = None
    term_grace_s: float = 2.0
    processes: dict[str, ProcessEntry] = {}

    @property
    def alive(self) -> dict[str, ProcessEntry]:
        """The processes that are really there."""
        return {id_: entry for id_, entry in self.processes.items() if entry.identity is not None and is_alive(entry.identity)}


class Desired(msgspec.Struct, frozen=True, kw_only=True):
    """What commands have made of the file: processes that were stopped, and solvers that were told to start or stop."""

    stopped: frozenset[str] = frozenset()
    solvers: dict[str, bool] = {}

    def with_process(self, id: str, *, wanted: bool) -> "Desired":  # noqa: A002  the word of the design
        """Return it after a process was started or stopped."""
        return Desired(stopped=self.stopped - {id} if wanted else self.stopped | {id}, solvers=self.solvers)

    def with_solver(self, id: str, running: bool | None) -> "Desired":  # noqa: A002
        """Return it after a solver began or ended to solve; None: it is as its table says."""
        others = {name: value for name, value in self.solvers.items() if name != id}
        return Desired(stopped=self.stopped, solvers=others if running is None else others | {id: running})

    def without(self, ids: set[str]) -> "Desired":
        """Return it without some processes."""
        return Desired(stopped=self.stopped - ids, solvers={id_: value for id_, value in self.solvers.items() if id_ not in ids})


S = TypeVar("S", bound=msgspec.Struct)


class DeploymentFolder:
    """The folder of one deployment. Only the control that holds its lock writes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock: IO[str] | None = None
        self._written: dict[Path, bytes] = {}

    @property
    def logs(self) -> Path:
        """Where its processes write."""
        return self.folder / "logs"

    def log_file(self, id: str) -> Path:  # noqa: A002  the word of the design
        """Return where a process writes."""
        return self.logs / f"{id}.log"

    def hold(self) -> None:
        """Become its only control until this process ends; HeldError names the one that is there, OSError: no such folder can be."""
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        lock = (self.folder / "control.lock").open("a+")
        deadline_s = time.monotonic() + _LOCK_WAIT_S
        while not _locked(lock):
            if time.monotonic() > deadline_s:
                lock.close()
                raise HeldError(self._holder())
            time.sleep(0.02)
        self._lock = lock

    def release(self) -> None:
        """Let another control come."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def is_held(self) -> bool:
        """Whether a control is there."""
        try:
            with (self.folder / "control.lock").open("r") as lock:
                return not _locked(lock)
        except OSError:
            return False

    def running(self) -> Running:
        """Return what was last written of the processes; nothing when that cannot be read."""
        return _read(self.folder / "processes.json", Running)

    def desired(self) -> Desired:
        """Return what commands have made of the file; nothing when that cannot be read."""
        return _read(self.folder / "desired.json", Desired)

    def write_running(self, running: Running) -> None:
        """Keep what is known of the processes, if that is new; OSError if that fails."""
        self._write(self.folder / "processes.json", running, durable=False)

    def write_desired(self, desired: Desired) -> None:
        """Keep what is wanted, if that is new; OSError if that fails."""
        self._write(self.folder / "desired.json", desired, durable=True)

    def strays(self, known: set[Identity]) -> dict[Identity, str]:
        """Return the processes that write into our logs and that nobody knows, with their ids: control died right after it started them."""
        found = {identity: file.name.partition(".log")[0] for identity, file in writers_below(self.logs).items()}
        return {who: id_ for who, id_ in found.items() if who not in known and id_ != CONTROL_LOG and who.pid != os.getpid()}

    def _write(self, file: Path, value: msgspec.Struct, *, durable: bool) -> None:
        encoded = msgspec.json.encode(value, order="deterministic")
        if self._written.get(file) != encoded:
            write_state(file, encoded, durable=durable)
            self._written[file] = encoded

    def _holder(self) -> str:
        running, name = self.running(), self.folder.name
        who = "" if running.control is None else f", pid {running.control.pid}"
        return f"{name} has a control already{who} (`rtkmesh cmd control reload` applies a changed file, `rtkmesh down {name}` ends it)"


def folder_of(site: Site) -> DeploymentFolder:
    """Return the folder of a deployment: its name for people, a hash of name, file and namespace for us."""
    table = site.deployment.deployment
    digest = hashlib.sha256("\0".join((table.name, str(site.file), table.namespace)).encode()).hexdigest()[:8]
    readable = re.sub(r"[^A-Za-z0-9_.-]", "_", table.name)[:40]
    return DeploymentFolder(state_folder() / FOLDER / f"{readable}-{digest}")


def all_folders() -> Iterator[DeploymentFolder]:
    """Yield the folders of all deployments that this host knows."""
    with suppress(OSError):
        for folder in sorted((state_folder() / FOLDER).iterdir()):
            if (folder / "processes.json").is_file():
                yield DeploymentFolder(folder)


def own_identity() -> Identity:
    """Return who this process is."""
    return identity_of(os.getpid()) or Identity(os.getpid(), 0, "")


def _locked(lock: IO[str]) -> bool:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        raise
    return True


def _read(file: Path, kind: type[S]) -> S:
    """Return the struct in a file; an empty one for a file that is missing or damaged."""
    try:
        if file.stat().st_size > _MAXIMUM_FILE:
            return kind()
        return msgspec.json.decode(file.read_bytes(), type=kind)
    except (OSError, msgspec.MsgspecError, RecursionError):
        return kind()
