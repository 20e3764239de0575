#!/usr/bin/env python3
"""What four receivers at 20 Hz with all their frames cost: hub and four ingests as processes, no solver, one subscriber.

  ingest_load.py [--data DIR] [--rate 20] [--seconds 30] [--quick] [--stages]

Streams (`load_streams.py`): a u-blox F9P (RXM-RAWX, RXM-SFRBX, NAV-PVT, NAV-SAT, NMEA), RTCM 3 MSM7 of five systems with ephemerides and
station, Septentrio's MeasEpoch, MeasExtra, PVTGeodetic and raw navigation blocks, Unicore's OBSVM, BESTNAV and ephemeris logs. All four
send an epoch at the same instant over TCP to `rtkmesh up`. The subscriber is this process: first of observations alone, then of all raw
frames too, as a recorder. Latency is from before an epoch's bytes are written to its observation in this process. CPU is user and system
time of each process (/proc/PID/stat) over the epochs counted, as a share of one core; PSS at their end.

The second table is processor time of this process for the stages of an ingest on the same bytes, microseconds an epoch, epoch after epoch;
"paced" is the sum of the same stages when an epoch comes at its instant only, so that caches are cold and the processor has slept. "rest"
is what an ingest needed in the first run beyond that: threads, sockets, the work loop, Zenoh, ticks and statuses.
"""

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

import kernel_cache  # noqa: F401  first of all
import rt_targets
from cases import data_folder
from load_streams import Receiver, receivers
from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.epoch import Epoch
from rtkmesh_schemas.keys import OBS, RAW, STATUS
from rtkmesh_schemas.observation import Observation
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import decode, encode
from rtkmesh_services.ingest.figures import SourceFigures
from rtkmesh_services.ingest.links import Chunk
from rtkmesh_services.ingest.replay import date_of
from rtkmesh_services.mapping.observation import observation_of
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.zenoh_bus import open_bus

RATE, SECONDS, QUICK_SECONDS = 20, 30.0, 5.0
WARM_S, START_S, LAST_S, PACED_S = 3.0, 90.0, 2.0, 5.0
BUDGET: Final = 100.0 / 3.0  # % of one core
REPEATS: Final = 3
DEPLOYMENT: Final = """
[deployment]
name = "ingest-load"
log_level = "warning"
[hub]
listen = ["tcp/127.0.0.1:{hub}"]
"""
INGEST: Final = """
[ingest.{name}]
source = "tcp://127.0.0.1:{port}"
date = "{date}"
"""


@dataclass
class Watched:
    """What came over the bus: samples of observations, bytes of raw frames, the processes' numbers."""

    observations: list[Sample] = field(default_factory=list[Sample])
    raw_frames: int = 0
    pids: dict[str, int] = field(default_factory=dict[str, int])

    def status(self, sample: Sample) -> None:
        """Take a status."""
        status = decode(ServiceStatus, sample.payload, sample.encoding)
        self.pids[status.id] = status.pid

    def raw(self, _: Sample) -> None:
        """Count a raw frame."""
        self.raw_frames += 1


@dataclass(frozen=True)
class Run:
    """One run: seconds and epochs measured; by process CPU %, PSS; by receiver latencies of the epochs that came (ms)."""

    seconds: float
    epochs: int
    cpu_pct: dict[str, float]
    pss_mib: dict[str, float]
    latency_ms: dict[str, list[float]]
    raw_frames: int


def cpu_s(pid: int) -> float:
    """Return user and system time of a process."""
    ticks = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(ticks[11]) + int(ticks[12])) / os.sysconf("SC_CLK_TCK")


def pss_mib(pid: int) -> float:
    """Return the proportional set size of a process."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1024.0
    return 0.0


def family(pid: int) -> set[int]:
    """Return a process and all that descend from it."""
    children = {int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()}
    return {pid}.union(*(family(child) for child in children))


def latencies_ms(sent_ns: dict[float, int], arrived_ns: dict[float, int], counted: Sequence[float]) -> list[float]:
    """Return how long each of the counted epochs took that came, by time of week."""
    return [(arrived_ns[tow_s] - sent_ns[tow_s]) * 1e-6 for tow_s in counted if tow_s in arrived_ns]


def quantile(values: Sequence[float], percent: float) -> float:
    """Return a quantile, NaN of nothing."""
    return float(np.percentile(values, percent)) if values else float("nan")


@contextmanager
def deployment(streams: Sequence[Receiver], folder: Path) -> Generator[tuple[str, int, list[socket.socket]]]:
    """Run `rtkmesh up` with an ingest for each stream; give the hub's address, the process, and the connected sockets."""
    hub, *ports = rt_targets.free_ports(1 + len(streams))
    servers = [socket.create_server(("127.0.0.1", port)) for port in ports]
    rows = [INGEST.format(name=stream.name, port=port, date=stream.date) for stream, port in zip(streams, ports, strict=True)]
    file = folder / f"load-{hub}.toml"
    file.write_text(DEPLOYMENT.format(hub=hub) + "".join(rows))
    process = subprocess.Popen([sys.executable, "-m", "rtkmesh_services.cli.main", "up", str(file), "--quiet"])
    try:
        yield f"tcp/127.0.0.1:{hub}", process.pid, [_accepted(server) for server in servers]
    finally:
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(10.0)
        process.kill()
        process.wait()


def _accepted(server: socket.socket) -> socket.socket:
    server.settimeout(START_S)
    connection, _ = server.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def measure(streams: Sequence[Receiver], rate: int, seconds: float, *, raw: bool) -> Run:
    """Play the streams into a deployment."""
    watched = Watched()
    with (
        tempfile.TemporaryDirectory() as folder,
        deployment(streams, Path(folder)) as (hub, up, sockets),
        open_bus("ingest-load", (hub,), timeout_s=START_S) as bus,
    ):
        bus.subscribe(STATUS.expression(), watched.status)
        bus.subscribe(OBS.expression(), watched.observations.append)
        if raw:
            bus.subscribe(RAW.expression(), watched.raw)
        _wait(lambda: {stream.name for stream in streams} <= set(bus.live()) & set(watched.pids))
        return _played(streams, sockets, watched, up, rate, round(seconds * rate))


def _wait(is_so: Callable[[], bool], timeout_s: float = START_S) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not is_so():
        if time.monotonic() > deadline_s:
            raise TimeoutError("the deployment does not start")
        time.sleep(0.05)


def _played(streams: Sequence[Receiver], sockets: list[socket.socket], watched: Watched, up: int, rate: int, epochs: int) -> Run:
    """Send all epochs at their instants; measure from the end of the warm ones on."""
    warm = round(WARM_S * rate)
    sent: dict[str, dict[float, int]] = {stream.name: {} for stream in streams}
    names, before, begun_s, raw_before = dict[int, str](), dict[int, float](), 0.0, 0
    start_s = time.monotonic()
    for number in range(warm + epochs):
        time.sleep(max(0.0, start_s + number / rate - time.monotonic()))
        if number == warm:
            names = process_names(up, watched.pids)
            before, begun_s, raw_before = {pid: cpu_s(pid) for pid in names}, time.monotonic(), watched.raw_frames
        for stream, connection in zip(streams, sockets, strict=True):
            tow_s, data = stream.slots[number]
            sent[stream.name][round(tow_s, 3)] = time.monotonic_ns()
            connection.sendall(data)
    _wait_for_last(watched, len(streams) * (warm + epochs))
    took_s = time.monotonic() - begun_s
    arrived = _arrived(watched.observations)
    counted = {stream.name: [round(tow_s, 3) for tow_s, _ in stream.slots[warm : warm + epochs]] for stream in streams}
    return Run(
        took_s,
        epochs,
        by_name(names, {pid: (cpu_s(pid) - begun) / took_s * 100.0 for pid, begun in before.items()}),
        by_name(names, {pid: pss_mib(pid) for pid in before}),
        {name: latencies_ms(sent[name], arrived.get(name, {}), tows) for name, tows in counted.items()},
        watched.raw_frames - raw_before,
    )


def _wait_for_last(watched: Watched, number: int) -> None:
    with suppress(TimeoutError):
        _wait(lambda: len(watched.observations) >= number, LAST_S)


def process_names(up: int, pids: dict[str, int]) -> dict[int, str]:
    """Return all processes of a deployment by number: those that publish a status by their id, others by what the system calls them."""
    told = {pid: name for name, pid in pids.items()}
    return {pid: told.get(pid) or Path(f"/proc/{pid}/comm").read_text().strip() for pid in sorted(family(up))}


def by_name(names: Mapping[int, str], values: Mapping[int, float]) -> dict[str, float]:
    """Return the sum of the values of all processes of a name."""
    return {name: sum(value for pid, value in values.items() if names[pid] == name) for name in names.values()}


def _arrived(samples: list[Sample]) -> dict[str, dict[float, int]]:
    found: dict[str, dict[float, int]] = {}
    for sample in samples:
        message = decode(Observation, sample.payload, sample.encoding)
        found.setdefault(message.source, {})[round(message.tow_s, 3)] = sample.received_mono_ns
    return found


def table(streams: Sequence[Receiver], run: Run, title: str) -> None:
    """Print a run."""
    names = [stream.name for stream in streams]
    print(f"| {title} | CPU % of a core | PSS MiB | epochs in | out | p50 ms | p99 ms |\n|---|---|---|---|---|---|---|")
    for name in names:
        values = run.latency_ms[name]
        figures = f"{run.epochs} | {len(values)} | {quantile(values, 50):.2f} | {quantile(values, 99):.2f}"
        print(f"| ingest {name} | {run.cpu_pct[name]:.1f} | {run.pss_mib[name]:.0f} | {figures} |")
    for name in (name for name in run.cpu_pct if name not in names):
        print(f"| {name} | {run.cpu_pct[name]:.1f} | {run.pss_mib[name]:.0f} | | | | |")
    ingests, total = sum(run.cpu_pct[name] for name in names), sum(run.cpu_pct.values())
    print(f"| four ingests | {ingests:.1f} | {sum(run.pss_mib[name] for name in names):.0f} | | | | |")
    verdict = "within" if total <= BUDGET else "above"
    print(f"| **all processes** ({verdict} the budget of {BUDGET:.0f} %) | **{total:.1f}** | {sum(run.pss_mib.values()):.0f} | | | | |")
    if run.raw_frames:
        print(f"\n{run.raw_frames / run.seconds:.0f} raw frames a second came to the subscriber.")
    print(f"\nLoad of the machine {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores.\n", flush=True)


def per_epoch_us(work: Callable[[], object], epochs: int) -> float:
    """Return the processor time of the best of some runs, microseconds an epoch."""
    best_s = float("inf")
    for _ in range(REPEATS):
        begun_s = time.process_time()
        work()
        best_s = min(best_s, time.process_time() - begun_s)
    return best_s / epochs * 1e6


def stages_us(stream: Receiver) -> dict[str, float]:
    """Return the processor time of each stage of an ingest in this process, microseconds an epoch."""
    chunks, count = [data for _, data in stream.slots], len(stream.slots)

    def decoded() -> list[list[tuple[Any, list[Message]]]]:
        decoder = StreamDecoder(StreamOptions(approximate_time=date_of(stream.date)))
        return [decoder.feed(chunk) for chunk in chunks]

    frames = decoded()
    epochs = [message for found in frames for _, some in found for message in some if isinstance(message, Epoch)]
    figures = SourceFigures()

    def framed() -> None:
        framer = Framer()
        for chunk in chunks:
            framer.feed(chunk)

    def figured() -> None:
        for data, found in zip(chunks, frames, strict=True):
            figures.chunk(Chunk(data, 0), found)

    wire = [observation_of(epoch, source=stream.name, start_id="", sequence=0) for epoch in epochs]
    framing = per_epoch_us(framed, count)
    return {
        "framing": framing,
        "decoding": per_epoch_us(decoded, count) - framing,
        "figures": per_epoch_us(figured, count),
        "columns": per_epoch_us(lambda: [observation_of(epoch, source="", start_id="", sequence=0) for epoch in epochs], count),
        "msgpack": per_epoch_us(lambda: [encode(message) for message in wire], count),
    }


def paced_us(stream: Receiver, rate: int) -> float:
    """Return the processor time of all stages when epochs come at their instants, microseconds an epoch."""
    decoder, figures, spent_s = StreamDecoder(StreamOptions(approximate_time=date_of(stream.date))), SourceFigures(), 0.0
    slots = stream.slots[: round(PACED_S * rate)]
    for _, data in slots:
        time.sleep(1.0 / rate)
        begun_s = time.thread_time()
        found = decoder.feed(data)
        figures.chunk(Chunk(data, 0), found)
        for message in (message for _, some in found for message in some if isinstance(message, Epoch)):
            encode(observation_of(message, source="", start_id="", sequence=0))
        spent_s += time.thread_time() - begun_s
    return spent_s / len(slots) * 1e6


def stage_table(streams: Sequence[Receiver], run: Run | None, rate: int) -> None:
    """Print where an ingest's time goes."""
    stages = {stream.name: stages_us(stream) for stream in streams}
    names = list(next(iter(stages.values())))
    print(f"| us an epoch | signals | frames | kB | {' | '.join(names)} | paced | rest |\n|---|---|---|---|{'---|' * (len(names) + 2)}")
    for stream in streams:
        row, paced = stages[stream.name], paced_us(stream, rate)
        rest = "" if run is None else f"{run.cpu_pct[stream.name] * 1e4 / rate - paced:.0f}"
        size = f"{stream.signals:.0f} | {stream.frames:.1f} | {stream.bytes_per_epoch / 1e3:.1f}"
        print(f"| {stream.name} | {size} | {' | '.join(f'{value:.0f}' for value in row.values())} | {paced:.0f} | {rest} |")


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder())
    parser.add_argument("--rate", type=int, default=RATE)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_SECONDS:.0f} s each")
    parser.add_argument("--stages", action="store_true", help="the second table alone")
    options = parser.parse_args()
    if options.data is None:
        parser.error("give --data or set RTKMESH_DATA")
    seconds = QUICK_SECONDS if options.quick else options.seconds
    streams = receivers(options.data, options.rate, round((seconds + WARM_S) * options.rate))
    run = None
    if not options.stages:
        run = measure(streams, options.rate, seconds, raw=False)
        table(streams, run, "observations")
        table(streams, measure(streams, options.rate, seconds, raw=True), "and raw frames")
    stage_table(streams, run, options.rate)
    return 0


if __name__ == "__main__":
    sys.exit(main())
