"""The word ``stream``: where the bytes come from and go to, as the processes at both ends say themselves."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from rtkmesh_schemas.config import Deployment, IngestTable, SolverTable
from rtkmesh_schemas.status import InputStatus, ServiceStatus, State
from rtkmesh_services.runtime.logs import clean
from rtkmesh_services.solver.neighbours import Neighbour, Neighbours

# Our schemes under RTKRCV's names; it has none for simulators and for streams of other processes.
INPUT_TYPES: Final = {"tcp": "tcpcli", "tcp-listen": "tcpsvr", "ntrip": "ntripcli", "ntrips": "ntripcli", "udp": "udpsvr", "stdin": "file"}
OUTPUT_TYPES: Final = {
    "tcp": "tcpcli", "tcp-listen": "tcpsvr", "ntrip": "ntripsvr", "ntrips": "ntripsvr", "ntrip-caster": "ntripcas", "udp": "udpcli",
    "stdout": "file",
}  # fmt: skip
_STATES: Final = {State.RUNNING: "C", State.DEGRADED: "E", State.STALE: "W", State.STOPPED: "-", State.FAILED: "E"}


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamRow:
    """One stream. ``state``: C open, W open and silent, E at fault, - closed or not there; rates are in bits a second."""

    name: str
    id: str = ""
    type: str = "-"
    format: str = "-"
    state: str = "-"
    input_bytes: int = 0
    input_bps: int = 0
    output_bytes: int = 0
    output_bps: int = 0
    path: str = ""
    message: str = ""


def stream_rows(table: SolverTable, deployment: Deployment, neighbours: Neighbours) -> list[StreamRow]:
    """Return RTKRCV's nine rows: three inputs, two outputs, three logs, monitor; more where a solver has more."""
    corrections = [name for name in neighbours.receivers if name not in (table.rover, table.base)] or [""]
    inputs = [("rover", table.rover), ("base", table.base), *(("corr", name) for name in corrections)]
    rows = [_input(f"input {word}", deployment, name, neighbours.of(name)) for word, name in inputs]
    outputs = [*neighbours.outputs, "", ""][: max(2, len(neighbours.outputs))]
    rows += [_output(f"output sol{number}", deployment, name, neighbours.of(name)) for number, name in enumerate(outputs, 1)]
    rows += [next(_logs(f"log {word}", name, neighbours), StreamRow(name=f"log {word}")) for word, name in inputs]
    return [*rows, StreamRow(name="monitor", format="llh")]


def streams_screen(rows: list[StreamRow]) -> str:
    """Return the rows as RTKRCV shows them."""
    counts = f"{'In-byte':>10s} {'In-bps':>7s} {'Out-byte':>10s} {'Out-bps':>7s}"
    head = f"{'Stream':<12s} {'Type':<8s} {'Fmt':<5s} S {counts} {'Path':<24s} Message\n"
    return head + "".join(f"{_line(row)}\n" for row in rows)


def streams_data(rows: list[StreamRow]) -> list[dict[str, Any]]:
    """Return the rows for ``Reply.data``."""
    return [asdict(row) for row in rows]


def _line(row: StreamRow) -> str:
    return (
        f"{row.name:<12s} {row.type:<8s} {row.format:<5s} {row.state} {row.input_bytes:10d} {row.input_bps:7d} {row.output_bytes:10d}"
        f" {row.output_bps:7d} {row.path:<24.24s} {row.message}"
    )


def _input(name: str, deployment: Deployment, receiver: str, neighbour: Neighbour) -> StreamRow:
    ingest = deployment.ingest.get(receiver)
    if ingest is None:
        return StreamRow(name=name)
    scheme, _, path = clean(ingest.source).partition("://")
    row = StreamRow(name=name, id=receiver, type=INPUT_TYPES.get(scheme, scheme), path=path, format=_format(ingest, None))
    status = neighbour.status()
    if status is None or not status.inputs:
        return replace(row, message="not heard of yet")
    source = status.inputs[0]
    rate = 0.0 if source.stream is None else source.stream.bytes_per_s
    return replace(
        row, state=_STATES.get(status.state, "-"), input_bytes=source.bytes, input_bps=round(8.0 * rate), format=_format(ingest, source),
        message=_message(status, source.state),
    )  # fmt: skip


def _format(table: IngestTable, source: InputStatus | None) -> str:
    """Return the protocol of the observations: as configured, else what most frames are of."""
    if table.observations != "auto":
        return table.observations
    counts: dict[str, int] = {}
    for kind, figures in ({} if source is None or source.stream is None else source.stream.frames).items():
        protocol = kind.partition("/")[0]
        counts[protocol] = counts.get(protocol, 0) + figures.count
    return max(counts, key=lambda protocol: counts[protocol], default="auto")


def _message(status: ServiceStatus, otherwise: str = "") -> str:
    return clean(status.reason or otherwise).replace("\n", " ")


def _output(name: str, deployment: Deployment, output: str, neighbour: Neighbour) -> StreamRow:
    table = deployment.output.get(output)
    if table is None:
        return StreamRow(name=name)
    scheme, _, path = clean(table.target).partition("://")
    row = StreamRow(name=name, id=output, type=OUTPUT_TYPES.get(scheme, scheme), format=table.format, path=path)
    status = neighbour.status()
    if status is None:
        return replace(row, message="not heard of yet")
    return replace(row, state=_STATES.get(status.state, "-"), **_sent(neighbour, status, ""), message=_message(status))


def _logs(name: str, receiver: str, neighbours: Neighbours) -> Iterator[StreamRow]:
    """Yield the logs of a receiver."""
    for recorder in neighbours.recorders if receiver else ():
        neighbour = neighbours.of(recorder)
        status = neighbour.status()
        for row in [] if status is None else status.inputs:
            log, _, protocol = row.name.partition("/")
            if status is not None and log == receiver:
                yield StreamRow(
                    name=name, id=recorder, type="file", format=protocol, state=_STATES.get(status.state, "-"), path=row.detail,
                    message=_message(status), **_sent(neighbour, status, row.name),
                )  # fmt: skip


def _sent(neighbour: Neighbour, status: ServiceStatus, name: str) -> dict[str, int]:
    """Return bytes and rate of what a process writes: of its row of that name, or of all."""
    pair, total = neighbour.pair(), _bytes(status, name)
    if pair is None:
        return {"output_bytes": total, "output_bps": 0}
    seconds = (pair[1].mono_ns - pair[0].mono_ns) * 1e-9
    return {"output_bytes": total, "output_bps": max(0, round(8.0 * (total - _bytes(pair[0], name)) / seconds))}


def _bytes(status: ServiceStatus, name: str) -> int:
    return sum(row.bytes for row in status.inputs if name in ("", row.name))
