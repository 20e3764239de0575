"""``rtkmesh up --detach``: control in a session of its own, which says when the fleet is as wanted."""

import json
import os
import select
import sys
import time
from contextlib import suppress
from typing import Any, Final

from rtkmesh_schemas.keys import CONTROL_ID, Role
from rtkmesh_services.control.fleet import READY_VARIABLE, ProcessSpec
from rtkmesh_services.control.keeper import Keeper
from rtkmesh_services.control.output import ProcessLog
from rtkmesh_services.control.process import start_program
from rtkmesh_services.control.records import ProcessState
from rtkmesh_services.control.registry import DeploymentFolder, folder_of
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.configuration import DATA_VARIABLE, Site
from rtkmesh_services.runtime.log_files import VARIABLE as LOG_VARIABLE

_SETTLED: Final = frozenset({ProcessState.RUNNING, ProcessState.STOPPED, ProcessState.FAILED})
_READ_BYTES: Final = 65536
_TOLD: Final = ("taken_over", "restarted", "started", "removed", "stopped")


def detached(site: Site, speed: str, *, fresh: bool, timeout_s: float, as_json: bool) -> int:
    """Start control in the background; return the exit code when the fleet is as wanted, or when that takes too long."""
    folder = folder_of(site)
    ready, theirs = os.pipe()
    spec = _control_spec(site, folder, speed, fresh=fresh, ready=theirs)
    try:
        folder.hold()  # says who has it
        folder.release()
        ProcessLog(spec).begins()
        process = start_program(spec, [theirs])
    except OSError as error:
        raise ServiceError(f"control cannot be started: {error}") from error
    finally:
        os.close(theirs)
    word = _word(ready, timeout_s)
    if word is None:
        sys.stderr.write(f"rtkmesh up: not all run after {timeout_s:g} s; `rtkmesh ps` shows them\n")
        return 1
    if not word:
        code = process.wait()
        sys.stderr.write(f"{ProcessLog(spec).last_error() or f'control ended with {code}'}\n")
        return code or 1
    _print(folder, json.loads(word), as_json=as_json)
    return 1 if json.loads(word)["failed"] else 0


class Announcement:
    """Says once, on the descriptor that the environment names, that the fleet is as wanted."""

    def __init__(self) -> None:
        name = os.environ.pop(READY_VARIABLE, "")
        self._descriptor = int(name) if name.isdecimal() else None
        self._begun_s = time.monotonic()

    def make(self, keeper: Keeper | None) -> None:
        """Say it when it is time: every process runs, has failed for good, or is stopped by command."""
        if self._descriptor is None or keeper is None:
            return
        rows = keeper.rows()
        if not rows or any(row["state"] not in _SETTLED or (row["wanted"] and row["state"] == ProcessState.STOPPED) for row in rows):
            return
        descriptor, self._descriptor = self._descriptor, None
        with suppress(OSError):  # nobody waits any more
            os.write(descriptor, json.dumps(self._word(keeper, rows)).encode())
        os.close(descriptor)

    def _word(self, keeper: Keeper, rows: list[dict[str, Any]]) -> dict[str, Any]:
        found, running = keeper.found, [row["id"] for row in rows if row["state"] == ProcessState.RUNNING]
        return {
            "seconds": round(time.monotonic() - self._begun_s, 3),
            "running": running,
            "taken_over": [id_ for id_ in running if id_ in found.kept],
            "restarted": [id_ for id_ in running if id_ in found.changed],
            "started": [id_ for id_ in running if id_ not in found.kept and id_ not in found.changed],
            "removed": list(found.removed),
            "stopped": [row["id"] for row in rows if row["state"] == ProcessState.STOPPED],
            "failed": {row["id"]: row["reason"] for row in rows if row["state"] == ProcessState.FAILED},
        }


def _control_spec(site: Site, folder: DeploymentFolder, speed: str, *, fresh: bool, ready: int) -> ProcessSpec:
    """Return how control is started: with all of our environment, for its processes may need it."""
    argv = [sys.executable, "-m", "rtkmesh_services.cli.main", "up", str(site.file), "--outlive", "--quiet"]
    argv += ["--fresh"] * fresh + (["--speed", speed] if speed else [])
    log_file = folder.log_file(CONTROL_ID)
    environment = {**os.environ, LOG_VARIABLE: str(log_file), READY_VARIABLE: str(ready)}
    if site.data_folder is not None:
        environment[DATA_VARIABLE] = str(site.data_folder)
    return ProcessSpec(CONTROL_ID, Role.CONTROL, tuple(argv), environment, log_file=log_file)


def _word(ready: int, timeout_s: float) -> bytes | None:
    """Return what control says, nothing when it has ended instead, None when it is late."""
    deadline_s, said = time.monotonic() + timeout_s, b""
    try:
        while select.select([ready], [], [], max(0.0, deadline_s - time.monotonic()))[0]:
            data = os.read(ready, _READ_BYTES)
            if not data:
                return said
            said += data
    finally:
        os.close(ready)
    return None


def _print(folder: DeploymentFolder, word: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        sys.stdout.write(json.dumps({"deployment": folder.folder.name, **word}) + "\n")
        return
    parts = [f"{what.replace('_', ' ')}: {', '.join(word[what])}" for what in _TOLD if word[what]]
    sys.stdout.write(f"{folder.folder.name}: {len(word['running'])} processes run after {word['seconds']:.1f} s; {'; '.join(parts)}\n")
    for id_, reason in word["failed"].items():
        sys.stderr.write(f"{id_} FAILED: {reason}\n")
