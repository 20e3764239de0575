"""The fleet of a deployment as a table: one row per process, with everything that is needed to start it."""

import hashlib
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.keys import HUB_ID, Role
from rtkmesh_services.runtime.configuration import DATA_VARIABLE
from rtkmesh_services.runtime.log_files import VARIABLE as LOG_VARIABLE
from rtkmesh_services.runtime.process import RUNNING_VARIABLE

ONE_THREAD: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
READY_VARIABLE: Final = "RTKMESH_READY"  # the descriptor on which a detached control says that the fleet is as wanted
# What must not reach our processes: it changes how Python starts, is the note of a ROS wheel that it has set LD_LIBRARY_PATH, or is meant
# for control alone.
_DROPPED_PREFIXES: Final = ("PYTHON", "LD_PRELOAD", "_ROS_WHEEL", "ROS_WHEEL", LOG_VARIABLE, RUNNING_VARIABLE, READY_VARIABLE)
_KEPT: Final = frozenset({"PYTHONUTF8", "PYTHONPYCACHEPREFIX", "PYTHONDONTWRITEBYTECODE", "PYTHONWARNINGS"})
_TABLES: Final = (Role.INGEST, Role.SOLVER, Role.ATTITUDE, Role.OUTPUT, Role.RECORDER, Role.ROS2, Role.MONITOR)


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One process of the fleet. ``tables`` are the parts of the file that it depends on: a change of them means a restart.

    With ``log_file`` it writes there and outlives control; without, control reads its output and it dies with control.
    """

    id: str
    role: Role
    argv: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict[str, str])
    tables: bytes = b""
    log_file: Path | None = None

    @property
    def definition(self) -> str:
        """A hash of what makes it the process that is wanted. The environment is not in it: control's own changes with every start."""
        return hashlib.sha256(b"\0".join([self.role.encode(), *map(os.fsencode, self.argv), self.tables])).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class LaunchOptions:
    """How the processes of a deployment are started: what the command line adds to the file."""

    file: Path
    data_folder: Path | None = None
    speed: str = ""
    python: str = sys.executable
    logs: Path | None = None  # where processes that outlive control write


def specs_of(deployment: Deployment, options: LaunchOptions) -> list[ProcessSpec]:
    """Return the processes of a deployment, the hub first. Control is not among them: it is their parent."""
    specs = [_spec(id_, role, deployment, options) for id_, role in processes_of(deployment)]
    assert len({spec.id for spec in specs}) == len(specs), "the configuration has checked that ids are unique"
    return specs


def processes_of(deployment: Deployment) -> Iterator[tuple[str, Role]]:
    """Yield (id, role) of every process but control, the hub first."""
    if deployment.hub.enabled:
        yield HUB_ID, Role.HUB
    for role in _TABLES:
        for id_ in getattr(deployment, role):
            yield id_, role


def restarts_between(old: list[ProcessSpec], new: list[ProcessSpec]) -> tuple[list[str], list[ProcessSpec], list[ProcessSpec]]:
    """Return (ids to remove, specs to add, specs to restart) that lead from one fleet to another."""
    before, after = {spec.id: spec for spec in old}, {spec.id: spec for spec in new}
    removed = [id_ for id_, spec in before.items() if id_ not in after or after[id_].role is not spec.role]
    added = [spec for id_, spec in after.items() if id_ not in before or id_ in removed]
    changed = [spec for id_, spec in after.items() if id_ in before and id_ not in removed and spec != before[id_]]
    return removed, added, changed


def clean_environment(inherited: Mapping[str, str], role: Role) -> dict[str, str]:
    """Return the environment of a child: one thread per numeric library, nothing that changes how Python starts.

    The ROS bridge keeps PYTHONPATH: it is how a sourced ROS makes rclpy importable.
    """
    kept = {name: value for name, value in inherited.items() if not name.startswith(_DROPPED_PREFIXES) or name in _KEPT}
    if role is Role.ROS2 and "PYTHONPATH" in inherited:
        kept["PYTHONPATH"] = inherited["PYTHONPATH"]
    return kept | ONE_THREAD | {"PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1", "MALLOC_ARENA_MAX": "2"}


def _spec(id_: str, role: Role, deployment: Deployment, options: LaunchOptions) -> ProcessSpec:
    table = None if role is Role.HUB else getattr(deployment, role)[id_]
    tables = msgspec.json.encode([deployment.deployment, deployment.hub, table, _referenced(table, deployment)])
    return spec_for(id_, role, options, tables, python=getattr(table, "python", ""))


def spec_for(
    id_: str, role: Role, options: LaunchOptions, tables: bytes, told: Mapping[str, str] | None = None, python: str = ""
) -> ProcessSpec:
    """Return how a process is started; ``told`` is added to its environment, ``python`` runs it instead of ours."""
    argv = [python or options.python, "-m", "rtkmesh_services.cli.main", "run", str(role), "--id", id_, "--config", str(options.file)]
    environment = clean_environment(os.environ, role) | dict(told or {})
    if options.data_folder is not None:
        environment[DATA_VARIABLE] = str(options.data_folder)
    if options.speed and role is not Role.HUB:
        argv += ["--speed", options.speed]
    log_file = None if options.logs is None else options.logs / f"{id_}.log"
    if log_file is not None:
        environment[LOG_VARIABLE] = str(log_file)
    return ProcessSpec(id_, role, tuple(argv), environment, tables, log_file)


def _referenced(table: Any, deployment: Deployment) -> list[Any]:
    """Return the tables of the processes that a table names: a solver's receivers, the solver of an attitude or output."""
    names: list[str] = [getattr(table, key, "") for key in ("rover", "base", "solver")]
    for key in ("navigation", "receivers", "solvers", "attitudes"):
        value = getattr(table, key, ())
        names += value if isinstance(value, tuple) else ()
    tables = (deployment.ingest, deployment.solver, deployment.attitude)
    return [group[name] for name in names for group in tables if name in group]
