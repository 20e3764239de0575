#!/usr/bin/env python3
"""Where the time of one attitude goes, from the last byte of the last receiver to the attitude in another process.

  attitude_stages.py [--rate HZ] [--seconds S] [--json]

Runs config/four_receivers.toml as processes (hub, five ingests, five solvers, attitude, monitor) on simulated bytes that come over TCP, all
receivers' at one instant, and stamps each epoch at the boundaries of the stages. A boundary is passed when the last process has passed it.
`waited` is from the arrival of the last baseline (or position) of the epoch at the attitude process until its attitude is with Zenoh, and
what the attitude itself says of that. Run `rtkmesh warm` first: what has to be compiled starts too late.
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
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import rt_targets
from latency_stages import Stamps, after, around_put, before, child, figures, listening, stamp_ingest, stamp_solver
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.keys import ATT, Role
from rtkmesh_schemas.wire import decode
from rtkmesh_services.control.fleet import clean_environment
from rtkmesh_services.runtime.process import PARENT_VARIABLE
from rtkmesh_services.runtime.zenoh_bus import ZenohBus, open_bus

FILE: Final = Path(__file__).parents[1] / "config" / "four_receivers.toml"
FIRST_TOW_S: Final = 200000.0
START_S: Final = 90.0  # of the processes, on a busy machine
WARM_S: Final = 20.0
# stage -> (stamp at its end, what happens in it); it begins at the stamp above it
STAGES: Final = {
    "sockets": ("ingests.read", "bytes sent -> read by the last ingest"),
    "ingests": ("ingests.put", "bytes -> epochs with Zenoh"),
    "solvers": ("solvers.put", "network, five solvers on the cores there are"),
    "network to attitude": ("boat.arrived", "Zenoh, through the hub"),
    "hand-over": ("boat.taken", "Zenoh's thread -> work loop"),
    "matching": ("boat.matched", "decode, match, are candidates wanted?"),
    "fit": ("boat.fitted", "rigid body, its test"),
    "levels": ("boat.judged", "message, protection levels"),
    "encode": ("boat.encoded", "attitude -> bytes"),
    "put": ("boat.put", "bytes -> Zenoh"),
    "network to user": ("user.arrived", "Zenoh, through the hub"),
}


def stamp_attitude(name: str, stamps: Stamps) -> None:
    """Stamp the attitudes of a body."""
    from rtkmesh_services.attitude.body import Body
    from rtkmesh_services.attitude.guard import Guard
    from rtkmesh_services.attitude.service import AttitudeService

    now: dict[str, Any] = {}

    def taken(_self: Any, sample: Any) -> None:
        now.update(arrived=sample.received_mono_ns, taken=time.monotonic_ns())

    def matched(_self: Any, epoch: Any) -> None:
        now.update(matched=time.monotonic_ns(), tow_s=epoch.time.tow_s)

    before(AttitudeService, "handle", taken)
    before(Body, "attitude", matched)
    after(Body, "attitude", lambda: now.update(fitted=time.monotonic_ns()))
    after(Guard, "of_body", lambda: now.update(judged=time.monotonic_ns()))
    around_put(ZenohBus, "att", name, now, stamps, ("arrived", "taken", "matched", "fitted", "judged"))


STAMPERS: Final = {"ingest": stamp_ingest, "solver": stamp_solver, "attitude": stamp_attitude}


def deployment(hub: int, ports: dict[str, int]) -> str:
    """Return the shipped deployment with its receivers at ports."""
    text = FILE.read_text().replace("tcp/127.0.0.1:7547", f"tcp/127.0.0.1:{hub}")
    for name, port in ports.items():
        antenna = _antenna(name)
        text = text.replace(f'"sim://boat/{antenna}?rate=2"', f'"tcp://127.0.0.1:{port}"')
    return text


def _antenna(name: str) -> str:
    source: str = tomllib.loads(FILE.read_text())["ingest"][name]["source"]
    return source.removeprefix("sim://boat/").split("?")[0]


def run(rate: float, seconds: float) -> dict[str, Any]:
    """Play simulated epochs through the processes; return the stages' quantiles, ms."""
    tables = tomllib.loads(FILE.read_text())
    hub, *ports = rt_targets.free_ports(1 + len(tables["ingest"]))
    receivers = dict(zip(tables["ingest"], ports, strict=True))
    start = GpsTime(GpsTime.from_utc(datetime.now(UTC)).week, FIRST_TOW_S)  # the base's RTCM does not say its week
    chunks = [_bytes_of(name, rate, start, int(rate * (START_S + WARM_S + seconds))) for name in receivers]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "deployment.toml"
        file.write_text(deployment(hub, receivers))
        feeds = [listening(port) for port in ports]
        roles = [("hub", "hub"), *((role, name) for role in ("ingest", "solver", "attitude", "monitor") for name in tables[role])]
        argv = [sys.executable, str(Path(__file__).resolve()), "--child"]
        environment = clean_environment(os.environ, Role.INGEST) | {PARENT_VARIABLE: str(os.getpid())}
        processes = {name: subprocess.Popen([*argv, r, name, str(file), f"{folder}/{name}.json"], env=environment) for r, name in roles}
        try:
            told = play(chunks, feeds, f"tcp/127.0.0.1:{hub}", rate, seconds)
        finally:
            for process in reversed(processes.values()):
                process.send_signal(signal.SIGTERM)
                process.wait(5.0)
        stamps: Stamps = {}
        for _, name in roles:
            stamps |= {key: dict(rows) for key, rows in json.loads(Path(f"{folder}/{name}.json").read_text()).items()}
    return quantiles(stamps, told, tables)


def _bytes_of(name: str, rate: float, start: GpsTime, epochs: int) -> list[bytes]:
    from rtkmesh.simulation.scenario import open_stream  # not in the children: it takes a second

    stream = open_stream("boat", _antenna(name), seed=1, rate_hz=rate, start=start).epochs()
    return [next(stream).data for _ in range(epochs)]


def play(chunks: list[list[bytes]], feeds: list[socket.socket], hub: str, rate: float, seconds: float) -> dict[str, Any]:
    """Send epochs at their instants, from the start on; return when each was sent, which is the first that counts, what attitudes came."""
    sent, told, first = list[int](), list[tuple[AttitudeMessage, int]](), -1
    with open_bus("attitude_stages", (hub,), timeout_s=START_S) as bus:

        def take(sample: Any) -> None:
            told.append((decode(AttitudeMessage, sample.payload, sample.encoding), sample.received_mono_ns))

        bus.subscribe(ATT.expression(), take)
        for feed in feeds:
            feed.settimeout(START_S)
        connections = [feed.accept()[0] for feed in feeds]
        begun = time.monotonic()
        for number, epoch in enumerate(zip(*chunks, strict=True)):
            if first < 0 and "boat" in bus.live():
                first = number + round(rate * WARM_S)
            if 0 <= first <= number - rate * seconds:
                break
            time.sleep(max(0.0, begun + number / rate - time.monotonic()))
            for connection, data in zip(connections, epoch, strict=True):
                connection.sendall(data)
            sent.append(time.monotonic_ns())
        time.sleep(1.0)  # what the last epochs give is under way, or never comes
    if first < 0:
        raise TimeoutError(f"the attitude did not start within {START_S:.0f} s")
    return {"sent": sent, "told": told, "rate": rate, "first": first}


def quantiles(stamps: Stamps, told: dict[str, Any], tables: dict[str, Any]) -> dict[str, Any]:
    """Return p50, p95, p99 and mean of each stage (ms) over the attitudes that passed their test."""
    rate, good = told["rate"], [(m, ns) for m, ns in told["told"] if m.integrity == "ok"]

    def number(tow_s: float) -> int:
        return round(tow_s * rate)  # receivers' tags are up to a millisecond off

    begin = number(FIRST_TOW_S)
    rows: dict[str, dict[int, int]] = {"user.sent": {begin + k: ns for k, ns in enumerate(told["sent"])}}
    rows["user.arrived"] = {number(m.tow_s): ns for m, ns in good}
    for role, kinds in (("ingest", ("read", "put")), ("solver", ("put",))):
        for kind in kinds:
            each = [{number(tow_s): ns for tow_s, ns in stamps[f"{name}.{kind}"].items()} for name in tables[role]]
            rows[f"{role}s.{kind}"] = {k: max(of[k] for of in each) for k in set.intersection(*(set(of) for of in each))}
    for key in (key for key in stamps if key.startswith("boat.")):
        rows[key] = {number(tow_s): ns for tow_s, ns in stamps[key].items()}
    complete = sorted(k for k in set.intersection(*(set(of) for of in rows.values())) if k - begin >= told["first"])
    columns = {key: np.array([of[k] for k in complete]) for key, of in rows.items()}
    result: dict[str, Any] = {"epochs": len(complete), "sent": len(told["sent"]) - told["first"]}
    start = "user.sent"
    for stage, (end, _) in STAGES.items():
        result[stage] = figures(columns[end] - columns[start])
        start = end
    result["all"] = figures(columns["user.arrived"] - columns["user.sent"])
    result["waited"] = figures(columns["boat.put"] - columns["boat.arrived"])
    kept = set(complete)
    result["waited, as told"] = figures(np.array([m.waited_ms * 1e6 for m, _ in good if number(m.tow_s) in kept]))
    return result


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--rate", type=float, default=2.0), p.add_argument("--seconds", type=float, default=40.0)
    p.add_argument("--data", help="not used: all is simulated")
    p.add_argument("--json", action="store_true"), p.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    o = p.parse_args()
    if o.child:
        child(*o.child, STAMPERS)
        return
    result = run(o.rate, o.seconds)
    if o.json:
        print(json.dumps(result, indent=1))
        return
    about = f"{result['epochs']} of {result['sent']} epochs at {o.rate:g} Hz, load {os.getloadavg()[0]:.1f}; ms"
    print(f"{about:66}" + "".join(f"{name:>8}" for name in ("p50", "p95", "p99", "mean")))
    for stage in [*STAGES, "all", "waited", "waited, as told"]:
        row, about = result[stage], STAGES.get(stage, ("", ""))[1]
        print(f"{stage:20} {about:45}" + "".join(f"{row[key]:8.3f}" for key in ("p50", "p95", "p99", "mean")))


if __name__ == "__main__":
    main()
