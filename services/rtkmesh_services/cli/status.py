"""``rtkmesh status``: the state of all processes of a running network."""

import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter

from rtkmesh_schemas.command import Reply
from rtkmesh_schemas.status import InputStatus, ServiceStatus, State
from rtkmesh_services.cli.network import DEFAULT_ENDPOINT, EXIT_FAILED, EXIT_OK, EXIT_UNREACHABLE, Connect, Json, Namespace, reach
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.runtime.logs import clean

if TYPE_CHECKING:
    from rich.table import Table

_WIDE = 200  # away from a terminal
_COLOURS = {
    State.RUNNING: "green",
    State.DEGRADED: "yellow",
    State.STALE: "yellow",
    State.FAILED: "red",
    State.STOPPED: "dim",
    State.WARMING: "cyan",
    State.STARTING: "cyan",
}


def status(
    id_: Annotated[str, Parameter(name="ID", help="One process: all that it tells, of a receiver's sources too.")] = "*",
    /,
    *,
    watch: Annotated[bool, Parameter(name=["--watch", "-w"], negative="", help="Show it again every second until Ctrl-C.")] = False,
    timeout: Annotated[float, Parameter(help="Seconds until a silent process counts as hung.")] = 1.0,
    as_json: Json = False,
    connect: Connect = DEFAULT_ENDPOINT,
    namespace: Namespace = "",
) -> int:
    """Show the state of all processes of a running network, also of those that are there and do not answer. With ID: one in full.

    Exit codes: 0 all well, 1 a process has failed or does not answer, 3 no network or nobody on it.
    """
    from rtkmesh_services.runtime.calls import call

    with reach(connect, namespace) as bus:
        while True:
            replies = call(bus, id_, "status", {}, timeout)
            if as_json:
                rows = [*map(_row, replies), *unanswering(replies)]
                sys.stdout.write(msgspec.json.encode(rows).decode() + "\n")
                sys.stdout.flush()
            else:
                show_status(replies, watch=watch, details=id_ != "*")
            if not watch:
                return status_exit_code(replies)
            time.sleep(1.0)


def status_of(reply: Reply) -> ServiceStatus | None:
    """Return the status in a reply, None when the process did not answer with one."""
    try:
        return msgspec.convert(reply.data, ServiceStatus) if reply.ok else None
    except msgspec.ValidationError:
        return None


def unanswering(replies: list[Reply]) -> list[dict[str, Any]]:
    """Return control's rows of the processes that it keeps and that are not on the network: failed, stopped, about to start."""
    heard = {reply.id for reply in replies}
    rows: list[dict[str, Any]] = []
    for found in filter(None, map(status_of, replies)):
        processes: Any = found.data.get("processes") if found.role == "control" else None
        rows += [row for row in processes or () if row["id"] not in heard]
    return rows


def _row(reply: Reply) -> dict[str, Any]:
    return reply.data if reply.ok else {"id": reply.id, "state": reply.code.value.upper(), "reason": reply.message}


def status_exit_code(replies: list[Reply]) -> int:
    """Return 0 when all is well, 1 when a process has failed or does not answer, 3 when nobody is there."""
    if not replies:
        return EXIT_UNREACHABLE
    found = [status_of(reply) for reply in replies]
    well = all(row is not None and row.state is not State.FAILED for row in found)
    return EXIT_OK if well and all(row["state"] != State.FAILED for row in unanswering(replies)) else EXIT_FAILED


def show_status(replies: list[Reply], *, watch: bool = False, details: bool = False) -> None:
    """Print the table, with ``details`` what processes tell of their sources too; with ``watch`` on an empty screen."""
    from rich.console import Console

    from rtkmesh_services.cli.receivers import source_details

    console = Console() if sys.stdout.isatty() else Console(width=_WIDE)
    if watch and console.is_terminal:
        console.clear()
    console.print(_table(replies) if replies else "the hub answers, but no process is on the network")
    for found in filter(None, map(status_of, replies) if details else ()):
        console.print(source_details(found))


def _table(replies: list[Reply]) -> "Table":
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("id", "role", "state", "up", "inputs", "latency p50/p99 ms", "reason"):
        table.add_column(name, justify="right" if name == "up" else "left", overflow="fold")
    for reply in replies:
        found = status_of(reply)
        if found is None:
            table.add_row(reply.id, "", Text(reply.code.value.upper(), "red"), "", "", "", Text(clean(reply.message)))
            continue
        latencies = ", ".join(f"{name} {row.p50:.1f}/{row.p99:.1f}" for name, row in found.latencies_ms.items())
        inputs = ", ".join(_input(row) for row in found.inputs)
        state = Text(found.state.value, _COLOURS[found.state])
        table.add_row(
            found.id,
            found.role,
            state,
            duration(found.uptime_s),
            Text(clean(inputs)),
            latencies,
            Text(clean(found.reason or _solution(found.data))),
        )
    for row in unanswering(replies):
        state = Text(row["state"], _COLOURS.get(row["state"], "yellow"))
        table.add_row(row["id"], row["role"], state, "", "", "", Text(clean(row["reason"])))
    return table


def _solution(data: Mapping[str, Any]) -> str:
    """Return what a solver's status says of its newest solution, empty for other processes."""
    if "integrity" not in data:
        return ""
    why = "" if data["integrity"] == "ok" else f" ({data['integrity_reason']})"
    return f"{data['solution']}, integrity {data['integrity']}{why}"


def _input(row: InputStatus) -> str:
    age = "" if row.age_s is None else f" {row.age_s:.1f}s"
    lost = f" lost {row.lost}" if row.lost else ""
    return f"{row.name} {row.state}{age}{lost}"


def duration(seconds: float) -> str:
    """Return a time in its usual unit."""
    minutes, hours = seconds / 60.0, seconds / 3600.0
    return f"{seconds:.0f}s" if minutes < 2.0 else f"{minutes:.0f}min" if hours < 2.0 else f"{hours:.0f}h"


app = command_page(
    status,
    """
    rtkmesh status
    rtkmesh status rover
    rtkmesh status --watch
    rtkmesh status --json --connect tcp/192.168.1.20:7547
    """,
)
