#!/usr/bin/env python3
"""Where the time of one epoch goes, from the receiver's last byte to the solution in another process.

  latency_stages.py [--data DIR] [--rate HZ] [--seconds S] [--json]

Runs hub, two ingests and a solver as processes on the stromlo recordings and stamps each epoch at the boundaries of the stages.
The stamps cost a few microseconds each; the whole is measured without them by realtime.py.
"""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import rt_judgement
import rt_logs
import rt_targets
from realtime import deployment
from rtkmesh_schemas.keys import SOL, Role
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.wire import decode
from rtkmesh_services.control.fleet import clean_environment
from rtkmesh_services.runtime.process import PARENT_VARIABLE
from rtkmesh_services.runtime.zenoh_bus import open_bus

WARM_EPOCHS = 30
CONNECT_S = 30.0
# stage -> (stamp at its end, whose, what happens in it); it begins at the stamp above it
STAGES = {
    "socket": ("rover.read", "bytes sent -> read by the ingest"),
    "ingest hand-over": ("rover.taken", "reading thread -> work loop"),
    "ingest decode": ("rover.decoded", "bytes -> epoch"),
    "ingest encode": ("rover.encoded", "epoch -> message"),
    "ingest put": ("rover.put", "message -> Zenoh"),
    "network to solver": ("rtk0.arrived", "Zenoh, through the hub"),
    "solver hand-over": ("rtk0.taken", "Zenoh's thread -> work loop"),
    "solver decode": ("rtk0.fed", "message -> epoch"),
    "pairing": ("rtk0.paired", "epoch -> pair"),
    "solve": ("rtk0.solved", "pair -> solution"),
    "solver encode": ("rtk0.encoded", "solution -> message"),
    "solver put": ("rtk0.put", "message -> Zenoh"),
    "network to user": ("user.arrived", "Zenoh, through the hub"),
}

Stamps = dict[str, dict[float, int]]


def child(role: str, name: str, file: str, out: str, stampers: dict[str, Callable[[str, Stamps], None]]) -> None:
    """Run one process of the deployment with stamps; write them when it ends."""
    from rtkmesh_services.runtime.kernel_cache import use_kernel_cache

    use_kernel_cache()
    from rtkmesh_services.cli import main

    stamps: Stamps = {}
    stampers.get(role, lambda *_: None)(name, stamps)
    from rtkmesh_services.runtime import process

    leave = process.leave

    def write_and_leave(code: int) -> None:
        Path(out).write_text(json.dumps({key: list(rows.items()) for key, rows in stamps.items()}))
        leave(code)

    process.leave = write_and_leave
    sys.argv = ["rtkmesh", "run", role, "--id", name, "--config", file]
    main.main()


def stamp_ingest(name: str, stamps: Stamps) -> None:
    """Stamp an ingest's epochs: those of a chunk get the chunk's stamps."""
    from rtkmesh_services.ingest.service import IngestService
    from rtkmesh_services.ingest.stream import StreamPublisher
    from rtkmesh_services.runtime.zenoh_bus import ZenohBus

    now: dict[str, Any] = {}

    def taken(_self: Any, chunk: Any) -> None:
        now.update(read=chunk.mono_ns, taken=time.monotonic_ns())

    def decoded(_self: Any, epoch: Any, _mono_ns: int) -> None:
        now.update(decoded=time.monotonic_ns(), tow_s=epoch.time.tow_s)

    before(IngestService, "_decode", taken)
    before(StreamPublisher, "_epoch", decoded)
    around_put(ZenohBus, "obs", name, now, stamps, ("read", "taken", "decoded"))


def stamp_solver(name: str, stamps: Stamps) -> None:
    """Stamp a solver's epochs."""
    from rtkmesh.gnss.epoch import Epoch
    from rtkmesh.rtk.session import Session, Source
    from rtkmesh_services.runtime.zenoh_bus import ZenohBus
    from rtkmesh_services.solver.service import SolverService

    now: dict[str, Any] = {}
    sample_stamps: dict[str, int] = {}

    def taken(_self: Any, sample: Any) -> None:
        sample_stamps.update(arrived=sample.received_mono_ns, taken=time.monotonic_ns())

    def fed(_self: Any, source: Any, message: Any, *_: Any) -> None:
        if source is Source.ROVER and isinstance(message, Epoch):
            now.update(sample_stamps, fed=time.monotonic_ns())

    def paired(_self: Any, pair: Any) -> None:
        now.update(paired=time.monotonic_ns(), tow_s=pair.rover.time.tow_s)

    before(SolverService, "handle", taken)
    before(Session, "feed", fed)
    before(Session, "solve", paired)
    after(Session, "solve", lambda: now.update(solved=time.monotonic_ns()))
    around_put(ZenohBus, "sol", name, now, stamps, ("arrived", "taken", "fed", "paired", "solved"))


def before(owner: type, method: str, act: Callable[..., None]) -> None:
    """Let ``act`` see the arguments of a method before it runs."""
    original = getattr(owner, method)

    def call(*args: Any) -> Any:
        act(*args)
        return original(*args)

    setattr(owner, method, call)


def after(owner: type, method: str, act: Callable[[], None]) -> None:
    """Call ``act`` when a method has run."""
    original = getattr(owner, method)

    def call(*args: Any) -> Any:
        result = original(*args)
        act()
        return result

    setattr(owner, method, call)


def around_put(owner: type, stream: str, name: str, now: dict[str, Any], stamps: Stamps, keys: tuple[str, ...]) -> None:
    """Take all stamps of an epoch when its message is put."""
    original = getattr(owner, "_put")  # noqa: B009  a private method, stamped from outside

    def call(self: Any, key: str, row: Any, *rest: Any) -> None:
        begun = time.monotonic_ns()
        original(self, key, row, *rest)
        if row.name == stream:
            values = {key: now[key] for key in keys} | {"encoded": begun, "put": time.monotonic_ns()}
            for kind, value in values.items():
                stamps.setdefault(f"{name}.{kind}", {})[now["tow_s"]] = value

    setattr(owner, "_put", call)  # noqa: B010  as above


def run(data: Path, rate: float, seconds: float) -> dict[str, Any]:
    """Play the recordings through the processes; return the stages' quantiles, ms."""
    stromlo = data / "stromlo_rtcm"
    logs = [rt_logs.load_log(str(stromlo / f"week-rollover-STR{n}.rtcm3"), "rtcm3", True) for n in (24, 17)]
    hub, rover, base = rt_targets.free_ports(3)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "deployment.toml"
        file.write_text(deployment(hub, rover, base))
        feeds = [listening(rover), listening(base)]
        roles = [("hub", "hub"), ("ingest", "rover"), ("ingest", "base"), ("solver", "rtk0")]
        argv = [sys.executable, str(Path(__file__).resolve()), "--child"]
        environment = clean_environment(os.environ, Role.INGEST) | {PARENT_VARIABLE: str(os.getpid())}
        processes = [subprocess.Popen([*argv, role, name, str(file), f"{folder}/{name}.json"], env=environment) for role, name in roles]
        try:
            stamps = play(logs, feeds, f"tcp/127.0.0.1:{hub}", rate, seconds)
        finally:
            for process in reversed(processes):
                process.send_signal(signal.SIGTERM)
                process.wait(5.0)
        for _, name in roles:
            for key, rows in json.loads(Path(f"{folder}/{name}.json").read_text()).items():
                stamps[key] = dict(rows)
    return quantiles(stamps)


def listening(port: int) -> socket.socket:
    """Return a socket that an ingest connects to."""
    server = socket.create_server(("127.0.0.1", port))
    server.settimeout(CONNECT_S)
    return server


def play(logs: list[Any], feeds: list[socket.socket], hub: str, rate: float, seconds: float) -> Stamps:
    """Send epochs at their instants; return when each was sent and when its solution came."""
    rover, base = logs
    sent: dict[float, int] = {}
    arrived: dict[float, int] = {}
    with open_bus("latency_stages", (hub,), timeout_s=10.0) as bus:

        def take(sample: Any) -> None:
            arrived[decode(SolutionMessage, sample.payload, sample.encoding).tow_s] = sample.received_mono_ns

        bus.subscribe(SOL.expression(), take)
        connections = [feed.accept()[0] for feed in feeds]
        deadline = time.monotonic() + CONNECT_S
        while "rtk0" not in bus.live():
            if time.monotonic() > deadline:
                raise TimeoutError(f"the solver did not start within {CONNECT_S:.0f} s")
            time.sleep(0.1)
        for connection, log in zip(connections, logs, strict=True):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.sendall(log.prime)
        begun = time.monotonic()
        first = int(np.searchsorted(rover.times, base.times[0] - 1e-3))
        for number in range(int(rate * seconds)):
            time.sleep(max(0.0, begun + number / rate - time.monotonic()))
            when = rover.times[first + number]
            partner = int(np.argmin(np.abs(base.times - when)))
            connections[1].sendall(base.chunks[partner])
            connections[0].sendall(rover.chunks[first + number])
            sent[round(float(when) % rt_judgement.WEEK, 3)] = time.monotonic_ns()
        time.sleep(1.0)
    return {"user.sent": sent, "user.arrived": arrived}


def quantiles(stamps: Stamps) -> dict[str, Any]:
    """Return p50, p95, p99 and mean of each stage, ms."""
    rounded = {key: {round(tow_s, 3): stamp for tow_s, stamp in rows.items()} for key, rows in stamps.items()}
    complete = sorted(set.intersection(*(set(rows) for rows in rounded.values())))[WARM_EPOCHS:]
    columns = {key: np.array([rows[tow_s] for tow_s in complete]) for key, rows in rounded.items()}
    result: dict[str, Any] = {"epochs": len(complete)}
    begin = "user.sent"
    for stage, (end, _) in STAGES.items():
        result[stage] = figures(columns[end] - columns[begin])
        begin = end
    result["all"] = figures(columns["user.arrived"] - columns["user.sent"])
    return result


def figures(values_ns: Any) -> dict[str, float]:
    """Return the quantiles of durations, ms."""
    p50, p95, p99 = np.percentile(values_ns * 1e-6, (50, 95, 99)).tolist()
    return {"p50": p50, "p95": p95, "p99": p99, "mean": float(values_ns.mean() * 1e-6)}


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--data", default=os.environ.get("RTKMESH_DATA", "../shared/data"))
    p.add_argument("--rate", type=float, default=10.0), p.add_argument("--seconds", type=float, default=20.0)
    p.add_argument("--json", action="store_true"), p.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    o = p.parse_args()
    if o.child:
        child(*o.child, {"ingest": stamp_ingest, "solver": stamp_solver})
        return
    result = run(Path(o.data), o.rate, o.seconds)
    if o.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{result['epochs']} epochs at {o.rate:g} Hz, load {os.getloadavg()[0]:.1f}; ms{'':22} p50     p95     p99    mean")
    for stage in [*STAGES, "all"]:
        row = result[stage]
        print(f"{stage:18} {STAGES.get(stage, ('', ''))[1]:33}" + "".join(f"{row[key]:8.3f}" for key in ("p50", "p95", "p99", "mean")))


if __name__ == "__main__":
    main()
