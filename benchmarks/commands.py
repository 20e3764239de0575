#!/usr/bin/env python3
"""How long commands wait for their answers while everything works: solver, ingest and control of a running deployment.

  commands.py [--rate 20] [--count 300] [--quick] [--data DIR]

`rtkmesh up` with a simulated rover and base at --rate epochs a second, a solver with two frequencies, the hub and control. When it fixes,
this process asks over its own Zenoh session, one question after the other with random pauses (0 to 10 ms), so that they come at any phase
of an epoch: --count of each word. The time is from before the question to after its decoded answer. Commands are also asked by four
threads at once, without pauses ("four at once"). Solutions are counted by their sequence numbers meanwhile: lost ones would show what
answering costs. The design allows 100 ms.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

import kernel_cache  # noqa: F401  first of all
import rt_targets
from rtkmesh_schemas.command import Reply, Request
from rtkmesh_schemas.keys import CMD, SOL
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.wire import decode, encode, encoding_of
from rtkmesh_services.runtime.bus import Bus, Sample
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.zenoh_bus import open_bus

BUDGET_MS = 100.0
FIX = 1
WAIT_S = 120.0
THREADS = 4

SITE = """
[deployment]
name = "commands"
log_level = "warning"
[hub]
listen = ["tcp/127.0.0.1:{port}"]
[ingest.rover]
source = "sim://demo/rover?rate={rate}&seed=1"
[ingest.base]
source = "sim://demo/base?rate={rate}&seed=1"
[solver.rtk]
rover = "rover"
base = "base"
navigation = ["rover"]
frequencies = 2
"""

# process, word, arguments: reads of all sizes, a write (log), a refusal, and what control does with its children's output
WORDS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("rtk", "status", {}),
    ("rtk", "metrics", {}),
    ("rtk", "config", {}),
    ("rtk", "log", {"level": "warning"}),
    ("rtk", "start", {}),
    ("rover", "status", {}),
    ("rover", "metrics", {}),
    ("rover", "log", {"level": "warning"}),
    ("control", "status", {}),
    ("control", "output", {"id": "rtk"}),
    ("control", "log", {"level": "warning"}),
)
REFUSED = {"start"}  # it runs: the answer says so


@dataclass(slots=True)
class Solutions:
    """What the solver publishes meanwhile."""

    fixes: int = 0
    sequences: list[int] = field(default_factory=list[int])
    latency_ms: list[float] = field(default_factory=list[float])

    def take(self, sample: Sample) -> None:
        solution = decode(SolutionMessage, sample.payload, sample.encoding)
        self.fixes += solution.status == FIX
        self.sequences.append(solution.sequence)
        self.latency_ms.append((solution.published_mono_ns - solution.received_mono_ns) * 1e-6)

    def lost(self) -> int:
        return self.sequences[-1] - self.sequences[0] + 1 - len(self.sequences) if self.sequences else 0


def until(condition: Callable[[], object], what: str) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise SystemExit(f"waited in vain: {what}")
        time.sleep(0.05)


def ask(bus: Bus, id_: str, op: str, args: dict[str, Any], number: int) -> float:
    """Ask once; return how long it took, ms."""
    request = Request(op=op, args=args, request_id=f"{os.getpid()}-{threading.get_ident()}-{op}-{number}", caller="benchmark")
    begun_s = time.perf_counter()
    [answer] = bus.get(CMD.key(id_), payload=encode(request), encoding=encoding_of(Request), timeout_s=5.0)
    reply = decode(Reply, answer.payload, answer.encoding)
    took_ms = (time.perf_counter() - begun_s) * 1e3
    assert reply.ok != (op in REFUSED and id_ == "rtk"), reply
    return took_ms


def one_after_the_other(bus: Bus, count: int) -> dict[tuple[str, str], list[float]]:
    """Ask every word in turn, at random instants."""
    random = Random(1)
    took: dict[tuple[str, str], list[float]] = {(id_, op): [] for id_, op, _ in WORDS}
    for number in range(count):
        for id_, op, args in WORDS:
            time.sleep(random.random() * 0.01)
            took[id_, op].append(ask(bus, id_, op, args, number))
    return took


def at_once(bus: Bus, count: int) -> list[float]:
    """Ask the solver's status by several threads without pauses."""
    took: list[float] = []

    def run() -> None:
        took.extend(ask(bus, "rtk", "status", {}, number) for number in range(count))

    threads = [threading.Thread(target=run) for _ in range(THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return took


def called(bus: Bus, count: int) -> list[float]:
    """Ask as `rtkmesh cmd` and the consoles do: with a look at who is there first."""
    took: list[float] = []
    for _ in range(count):
        begun_s = time.perf_counter()
        assert call(bus, "rtk", "status")[0].ok
        took.append((time.perf_counter() - begun_s) * 1e3)
        time.sleep(0.005)
    return took


def row(name: str, took: list[float]) -> None:
    p50, p99 = np.percentile(took, (50, 99))
    over = sum(one > BUDGET_MS for one in took)
    print(f"| {name} | {len(took)} | {p50:.2f} | {p99:.2f} | {max(took):.1f} | {over} |", flush=True)


def measure(bus: Bus, count: int, rate: int) -> None:
    seen, quiet = Solutions(), Solutions()
    bus.subscribe(SOL.key("rtk"), seen.take)
    until(lambda: seen.fixes > 2 * rate, "fixes")
    bus.subscribe(SOL.key("rtk"), quiet.take)
    until(lambda: len(quiet.sequences) >= 5 * rate, "solutions without commands")
    before = np.percentile(quiet.latency_ms, (50, 99))
    asked = Solutions()
    handle = bus.subscribe(SOL.key("rtk"), asked.take)
    print(f"| process and word, {rate} epochs a second | asked | p50 ms | p99 ms | max ms | over {BUDGET_MS:.0f} ms |")
    print("|---|---|---|---|---|---|")
    took = one_after_the_other(bus, count)
    for (id_, op), times in took.items():
        row(f"{id_} {op}", times)
    row("all of them", [one for times in took.values() for one in times])
    row("rtk status, four at once", at_once(bus, count))
    row("rtk status by `call`", called(bus, count))
    handle.close()
    after = np.percentile(asked.latency_ms, (50, 99))
    print(
        f"\nSolutions meanwhile: {len(asked.sequences)}, lost {asked.lost()}; receipt of the rover's epoch to publication p50 / p99"
        f" {after[0]:.1f} / {after[1]:.1f} ms, without commands {before[0]:.1f} / {before[1]:.1f} ms."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=int, default=20)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--data", help="not needed")
    options = parser.parse_args()
    count = 30 if options.quick else options.count
    [port] = rt_targets.free_ports(1)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "commands.toml"
        file.write_text(SITE.format(port=port, rate=options.rate))
        command = [sys.executable, "-m", "rtkmesh_services.cli.main", "up", str(file), "--quiet"]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        try:
            with open_bus("benchmark", [f"tcp/127.0.0.1:{port}"], timeout_s=WAIT_S) as bus:
                until(lambda: {"rtk", "rover", "base", "control"} <= set(bus.live()), "the processes")
                measure(bus, count, options.rate)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(20.0)


if __name__ == "__main__":
    main()
