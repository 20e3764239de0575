#!/usr/bin/env python3
"""A running deployment and rtkrcv on the same bytes in real time: latency, pairing, CPU, memory, start-up, recovery.

  realtime.py [--data DIR] [--only NAME,...] [--seconds S] [--rtkrcv rtkrcv] [--json]

Feeds the stromlo recordings (RTCM 3, five systems, before the week rollover) over TCP at 10 epochs/s (patterns: 5 epochs/s) to
`rtkmesh up` and, in the same run, to RTKLIB's rtkrcv if it is installed. Solutions of ours are taken from the bus by another
process's Zenoh session (this one), those of rtkrcv from its TCP output. What is measured is explained in rt_load.py.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import rt_load
import rt_logs
import rt_targets
from rtkmesh_schemas.keys import SOL
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.wire import decode
from rtkmesh_services.runtime.zenoh_bus import open_bus

BASE_ECEF_M = (-4467102.3061, 2683039.5304, -3666949.9820)
TRUTH_ECEF_M = (-4467074.3577, 2683011.9038, -3667008.2845)

# name -> (epochs per second, rt_load pattern, further options of rt_load.run; "solvers": how many, each with its own process)
CASES = {
    "in step 10 Hz": (10, "step", {}),
    "base 50 ms early": (5, "early:50", {}),
    "base 5 ms late": (5, "late:5", {}),
    "base 60 ms late": (5, "late:60", {}),
    "base 260 ms late": (5, "late:260", {}),
    "base twice": (5, "dup:50", {}),
    "bursts of five": (5, "burst:5", {}),
    "bursts 60 ms late": (5, "burst:5:60", {}),
    "random 0-400 ms": (5, "jitter:0:400", {}),
    "every tenth late": (5, "kth:10:310:60", {}),
    "rover away 3 s": (5, "step", {"outages": [("rover", 8.0, 3.0)]}),
    "bit errors 1e-5": (5, "step", {"flip": 1e-5}),
    "bit errors 1e-4": (5, "step", {"flip": 1e-4}),
    "cold start": (10, "step", {"cold": True}),
    "20 solvers 10 Hz": (10, "step", {"solvers": 20}),
}

DEPLOYMENT = """
[deployment]
name = "realtime"
log_level = "warning"
[hub]
listen = ["tcp/127.0.0.1:{hub}"]
[ingest.rover]
source = "tcp://127.0.0.1:{rover}"
[ingest.base]
source = "tcp://127.0.0.1:{base}"
position_ecef_m = [{x}, {y}, {z}]
"""

SOLVER = """
[solver.rtk{number}]
rover = "rover"
base = "base"
mode = "kinematic"
frequencies = 2
systems = "GREJC"
"""

RTKRCV = """
pos1-posmode =kinematic
pos1-frequency =l1+2
pos1-elmask =15
pos1-dynamics =off
pos1-navsys =61
pos1-ionoopt =brdc
pos1-tropopt =saas
pos2-armode =continuous
pos2-arthres =3
pos2-maxage =30
out-outsingle =off
ant2-postype =xyz
ant2-pos1 ={x}
ant2-pos2 ={y}
ant2-pos3 ={z}
"""


class BusSolutions:
    """rt_load plug-in: the solutions of all solvers of one hub."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint

    def start(self, push) -> None:
        self._bus = open_bus("benchmark", (self._endpoint,))

        def take(sample) -> None:
            solution = decode(SolutionMessage, sample.payload, sample.encoding)
            push(int(solution.source.removeprefix("rtk")), solution.tow_s, solution.status, solution.age_s, solution.position_ecef_m)

        self._bus.subscribe(SOL.expression(), take)

    def stop(self) -> None:
        self._bus.close()


class Deployment(rt_targets.Spawn):
    """One command that runs several solvers."""

    def __init__(self, command: str, solvers: int, rover: str, base: str) -> None:
        super().__init__(command, 1, rover, base)
        self._solvers = solvers

    def start(self) -> None:
        super().start()
        self.count = self._solvers


def ours(folder: Path, solvers: int):
    hub, rover, base = rt_targets.free_ports(3)
    file = folder / f"deployment-{hub}.toml"
    file.write_text(deployment(hub, rover, base, solvers))
    target = Deployment(f"{sys.executable} -m rtkmesh_services.cli.main up {file} --quiet", solvers, str(rover), str(base))
    target.solutions = lambda: [f"plugin:realtime:BusSolutions:tcp/127.0.0.1:{hub}"]
    return target, f"listen:{rover}", f"listen:{base}"


def deployment(hub: int, rover: int, base: int, solvers: int = 1) -> str:
    """Return the deployment file of two receivers and their solvers, rtk0, rtk1, ..."""
    x, y, z = BASE_ECEF_M
    receivers = DEPLOYMENT.format(hub=hub, rover=rover, base=base, x=x, y=y, z=z)
    return receivers + "".join(SOLVER.format(number=number) for number in range(solvers))


def rtkrcv(folder: Path, binary: str, count: int):
    rover, base = rt_targets.free_ports(2)
    conf = folder / "rtkrcv.conf"
    x, y, z = BASE_ECEF_M
    conf.write_text(RTKRCV.format(x=x, y=y, z=z))
    return rt_targets.Rtkrcv(binary, count, str(conf), ("rtcm3", "rtcm3"), str(rover), str(base), []), f"listen:{rover}", f"listen:{base}"


def measure(logs, target_at, name: str, seconds: float) -> dict:
    rate, pattern, options = CASES[name]
    more = {key: value for key, value in options.items() if key != "solvers"}
    target, rover_at, base_at = target_at
    if isinstance(target, Deployment):
        more["clients"] = 1  # one ingest feeds all solvers
    try:
        return rt_load.run(*logs, target, rover_at, base_at, interval=1.0 / rate, seconds=seconds, pattern=pattern, tree=True,
                           truth=TRUTH_ECEF_M, **more)  # fmt: skip
    finally:
        target.stop()


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--data", default=os.environ.get("RTKMESH_DATA", "../shared/data"))
    p.add_argument("--only"), p.add_argument("--seconds", type=float, default=20.0)
    p.add_argument("--rtkrcv", default="rtkrcv"), p.add_argument("--json", action="store_true")
    o = p.parse_args()
    os.environ.setdefault("PYTHONPATH", str(Path(__file__).parent))
    stromlo = Path(o.data) / "stromlo_rtcm"
    logs = [rt_logs.load_log(str(stromlo / f"week-rollover-STR{n}.rtcm3"), "rtcm3", True) for n in (24, 17)]
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in [c for c in CASES if not o.only or c in o.only.split(",")]:
            solvers = CASES[name][2].get("solvers", 1)
            targets = {"rtkmesh": partial(ours, Path(folder), solvers)}
            if shutil.which(o.rtkrcv):
                targets["rtkrcv b34"] = partial(rtkrcv, Path(folder), o.rtkrcv, solvers)
            for who, make in targets.items():
                results.setdefault(name, {})[who] = r = measure(logs, make(), name, o.seconds)
                if not o.json:
                    print(f"{name:20} {who:12} {summary(r)}", flush=True)
    if o.json:
        print(json.dumps(results, indent=1))


def summary(r: dict) -> str:
    """One line: epochs solved, in time, with their own base epoch, fixed; latency from the later of both streams; cost; load."""
    t = r["targets"][0]
    latency = t.get("latency_from_both_ms") or {}
    parts = [
        f"solved {t['solved_pct']:6.2f} %",
        *([f"in time {t['in_time_pct']:6.2f} %"] if t["instances"] > 1 else []),
        f"age 0 {t['age0_pct']:6.2f} %",
        f"fix {t['q_pct'].get('1', 0.0):5.1f} %",
        "ms p50 {p50:7.2f} p99 {p99:7.2f} max {max:7.2f}".format(**latency) if latency else "no latency",
        f"cpu {t.get('cpu_pct_of_core', float('nan')):5.1f} %",
        f"pss {t.get('pss_mib_mean', float('nan')):6.1f} MiB",
        f"first {t.get('spawn_to_first_solution_s', float('nan')):.2f} s",
        f"load {os.getloadavg()[0]:.1f}",
    ]
    if "after_outage" in t:
        parts.append(f"back: {t['after_outage']}")
    if not r["driver_kept_up"]:
        parts.append("(the driver did not keep up: do not believe the latency)")
    return "  ".join(parts)


if __name__ == "__main__":
    main()
