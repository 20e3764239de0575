"""``rtkmesh ps``: the deployments of this host and their processes, also of one whose control is dead."""

import json
import sys
from collections.abc import Mapping
from typing import Annotated, Any, Final

from cyclopts import Parameter

from rtkmesh_schemas.keys import CONTROL_ID
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_services.cli.deployments import Known, is_up, known_deployments
from rtkmesh_services.cli.network import EXIT_FAILED, EXIT_OK, EXIT_UNREACHABLE, Json, reach
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.control.registry import Desired, ProcessEntry, Running
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.host_processes import Identity, is_alive, memory_bytes, uptime_s

ENDED: Final = "ENDED"
_ANSWER_S: Final = 0.4
_HEADS: Final = ("id", "role", "state", "says", "wanted", "pid", "up", "restarts", "MB", "reason")
_MEGABYTE: Final = 1e6


def ps(
    *,
    everything: Annotated[bool, Parameter(name=["--all", "-a"], negative="", help="Deployments that are not up too.")] = False,
    as_json: Json = False,
) -> int:
    """Show all deployments of this host: processes with state, pid, uptime, restarts and memory, and what is wanted of them.

    State is what control last saw (or whether the process is there, if control is not); says is the process's own word.
    Memory is the proportional set size: what several processes share counts by their share.

    Exit codes: 0 all is as wanted, 1 a process has failed or ended or a deployment has no control, 3 none is up.
    """
    found = [picture(known) for known in known_deployments() if everything or is_up(known)]
    if as_json:
        sys.stdout.write(json.dumps(found) + "\n")
    elif not found:
        sys.stdout.write("no deployment is up on this host\n")
    else:
        for one in found:
            _print(one)
    if not found:
        return EXIT_UNREACHABLE
    return EXIT_OK if all(one["as_wanted"] for one in found) else EXIT_FAILED


def picture(known: Known) -> dict[str, Any]:
    """Return all that is known of one deployment, as plain values."""
    folder, running = known
    # A killed control may hold its lock for a moment longer than it lives.
    held = folder.is_held() and running.control is not None and is_alive(running.control)
    desired = folder.desired()
    says = _statuses(running) if held or running.alive else {}
    rows = [_row(entry, desired, says.get(entry.id), held=held) for entry in running.processes.values()]
    if held and running.control is not None:
        rows.append(_control_row(running.control, says.get(CONTROL_ID)))
    rows += [_stray_row(who, id_) for who, id_ in folder.strays({e.identity for e in running.processes.values() if e.identity}).items()]
    return {
        "name": folder.folder.name,
        "file": running.file,
        "namespace": running.namespace,
        "endpoints": list(running.endpoints),
        "outlive": running.outlive,
        "control": running.control.pid if held and running.control is not None else None,
        "as_wanted": held and all(row["as_wanted"] for row in rows),
        "processes": rows,
    }


def _row(entry: ProcessEntry, desired: Desired, status: ServiceStatus | None, *, held: bool) -> dict[str, Any]:
    who = entry.identity if entry.identity is not None and is_alive(entry.identity) else None
    state = entry.state if held and (who is not None) == (entry.identity is not None) else "RUNNING" if who is not None else ENDED
    wanted = entry.id not in desired.stopped
    told = {None: "", True: "start", False: "stop"}[desired.solvers.get(entry.id)]
    ours = status is not None and who is not None and (status.pid, status.start_id) == (who.pid, entry.start_id or status.start_id)
    reason = entry.reason if held else ""
    if status is not None and who is not None and not ours:
        reason = f"another process has this id: pid {status.pid} on {status.host}"
    return {
        "id": entry.id,
        "role": entry.role.value,
        "state": state,
        "says": str(status.state) if status is not None and ours else "",
        "wanted": wanted,
        "told": told,
        **_figures(who),
        "start_id": entry.start_id,
        "restarts": entry.restarts,
        "reason": reason or (status.reason if status is not None and ours else ""),
        "as_wanted": state == ("RUNNING" if wanted else "STOPPED"),
    }


def _control_row(who: Identity, status: ServiceStatus | None) -> dict[str, Any]:
    says = "" if status is None or status.pid != who.pid else str(status.state)
    row = {"id": CONTROL_ID, "role": "control", "state": "RUNNING", "says": says, "wanted": True, "told": "", "restarts": 0}
    return {**row, **_figures(who), "reason": "", "as_wanted": True}


def _stray_row(who: Identity, id_: str) -> dict[str, Any]:
    row = {"id": id_, "role": "", "state": "RUNNING", "says": "", "wanted": False, "told": "", "restarts": 0}
    return {**row, **_figures(who), "reason": "no control knows it", "as_wanted": False}


def _figures(who: Identity | None) -> dict[str, Any]:
    if who is None:
        return {"pid": 0, "uptime_s": 0.0, "memory_bytes": None}
    return {"pid": who.pid, "uptime_s": round(uptime_s(who), 1), "memory_bytes": memory_bytes(who.pid)}


def _statuses(running: Running) -> dict[str, ServiceStatus]:
    """Return what the processes say themselves, as far as they can be asked."""
    from rtkmesh_services.cli.status import status_of
    from rtkmesh_services.runtime.calls import call

    try:
        with reach(",".join(running.endpoints), running.namespace) as bus:
            replies = call(bus, "*", "status", {}, _ANSWER_S)
    except ServiceError:
        return {}
    return {status.id: status for status in map(status_of, replies) if status is not None}


def _print(one: Mapping[str, Any]) -> None:
    from rtkmesh_services.cli.plain_table import print_table
    from rtkmesh_services.runtime.logs import clean

    control = f"control pid {one['control']}" if one["control"] else "NO CONTROL" if one["processes"] else "not up"
    how = "detached" if one["outlive"] else "in the foreground"
    sys.stdout.write(f"{one['name']}  {one['file']}  {control}, {how}\n")
    print_table(_HEADS, [[clean(cell) for cell in _cells(row)] for row in one["processes"]], right=("pid", "up", "restarts", "MB"))


def _cells(row: Mapping[str, Any]) -> list[str]:
    from rtkmesh_services.cli.status import duration

    there = bool(row["pid"])
    wanted = ("run" if row["wanted"] else "stop") + (f", told {row['told']}" if row["told"] else "")
    memory = "" if row["memory_bytes"] is None else f"{row['memory_bytes'] / _MEGABYTE:.1f}"
    uptime, pid = (duration(row["uptime_s"]), str(row["pid"])) if there else ("", "")
    return [row["id"], row["role"], row["state"], row["says"], wanted, pid, uptime, str(row["restarts"]), memory, row["reason"]]


app = command_page(
    ps,
    """
    rtkmesh ps
    rtkmesh ps --all --json
    """,
)
