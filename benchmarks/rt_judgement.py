"""What ``rt_load`` measures: what processes use of the machine, which solutions came of the epochs that were sent, how soon, and how old.

Moments are those of ``time.monotonic`` (s). Runs with numpy alone.
"""

import collections
import contextlib
import os
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Entry = dict[str, Any]

WEEK: Final = 604800.0  # s
_TICK: Final = os.sysconf("SC_CLK_TCK")
_KEPT: Final = 12  # epochs without a solution that are named


class Record(NamedTuple):
    """A solution: of which target and which instance of it; time of week (s; where a line says no more, ("tod", time of day)), RTKLIB's Q,
    age of the base (s), position (ECEF, m) if it is said; the moment at which it came.
    """

    target: int
    instance: int
    tow: float | tuple[str, float]
    q: int
    age_s: float
    xyz: Sequence[float] | None
    moment: float


class Plan(NamedTuple):
    """What is sent: interval (s) between rover epochs and their spacing in the log; how many; their places in the rover's log, and those of
    the base epochs in theirs; events (moment, order, what, number or feed), sorted.
    """

    interval: float
    spacing: float
    count: int
    index: NDArray[np.int64]
    inside: NDArray[np.int64]
    events: list[tuple[float, int, str, Any]]


class Sent:
    """What was sent when: moments of rover epochs (NaN: not sent) and of base epochs by place in their log; how late (ms); bits flipped."""

    def __init__(self, count: int) -> None:
        self.rover, self.base = np.full(count, np.nan), dict[int, float]()
        self.late, self.flips, self.dirty, self.ups = list[float](), 0, set[int](), list[tuple[str, float]]()


# --- what processes use ---


def _cpu(pid: int) -> tuple[float, int, int]:
    """Return processor time (s), parent and threads of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(") ", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICK, int(fields[1]), int(fields[17])


def _busy() -> tuple[float, float]:
    """Return for how long (s) the machine's cores have been busy, and were not there."""
    with Path("/proc/stat").open() as file:
        fields = [int(x) for x in file.readline().split()[1:9]]
    return (sum(fields) - fields[3] - fields[4]) / _TICK, fields[7] / _TICK


def _memory_kib(pid: int) -> tuple[int, int]:
    """Return RSS and PSS of a process."""
    lines = (line.split() for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines())
    sizes = {line[0]: int(line[1]) for line in lines if line[0] in ("Rss:", "Pss:")}
    return sizes.get("Rss:", 0), sizes.get("Pss:", 0)


class Sampler(threading.Thread):
    """CPU seconds, RSS and PSS of some processes (and of their descendants), once a second; and of the machine."""

    def __init__(self, pids: Iterable[int], tree: bool = False, period: float = 1.0) -> None:
        super().__init__(daemon=True)
        self.pids, self.tree, self.period, self.halt = list(pids), tree, period, threading.Event()
        self.first, self.last, self.threads = dict[int, float](), dict[int, float](), 0
        self.rss_mib, self.pss_mib = list[float](), list[float]()
        self.begun: tuple[float, tuple[float, float], float] | None = None  # now, the machine, the driver

    def members(self) -> set[int]:
        """Return the processes, with their descendants where these count."""
        if not self.tree:
            return set(self.pids)
        parent = dict[int, int]()
        for path in Path("/proc").iterdir():
            if path.name.isdigit():
                with contextlib.suppress(OSError):
                    parent[int(path.name)] = _cpu(int(path.name))[1]
        group, grown = set(self.pids), True
        while grown:
            more = {p for p, q in parent.items() if q in group and p not in group}
            group |= more
            grown = bool(more)
        return group

    def sample(self, memory: bool = True) -> None:
        """Note what the processes that are there use now."""
        rss = pss = threads = 0
        for p in self.members():
            try:
                cpu_s, _, count = _cpu(p)
                threads += count
                self.first.setdefault(p, 0.0 if self.last else cpu_s)
                self.last[p] = cpu_s
                sizes = _memory_kib(p) if memory else (0, 0)
            except OSError:
                continue
            rss, pss = rss + sizes[0], pss + sizes[1]
        if rss:
            self.rss_mib.append(rss / 1024)
            self.pss_mib.append(pss / 1024)
        self.threads = max(self.threads, threads)

    def run(self) -> None:
        """Sample until the result is asked for."""
        self.sample()
        while not self.halt.wait(self.period):
            self.sample()

    def mark(self) -> None:
        """Begin the measured window."""
        self.sample(False)
        self.first = dict(self.last)
        self.begun = time.monotonic(), _busy(), time.process_time()

    def result(self) -> Entry:
        """Return what was used since the mark; nothing without one."""
        if self.begun is None:
            return {}
        self.sample(False)
        self.halt.set()
        wall_s, own_s = time.monotonic() - self.begun[0], time.process_time() - self.begun[2]
        cpu_s = sum(last - self.first.get(p, 0.0) for p, last in self.last.items())
        busy_s, steal_s = (b - a for a, b in zip(self.begun[1], _busy(), strict=True))
        machine_s = wall_s * (os.cpu_count() or 1)
        return {
            "wall_s": round(wall_s, 2), "cpu_s": round(cpu_s, 3), "cpu_pct_of_core": round(100 * cpu_s / wall_s, 2),
            "processes": len(self.last), "threads": self.threads,
            "rss_mib_mean": _mean(self.rss_mib), "rss_mib_peak": round(max(self.rss_mib, default=0), 1),
            "pss_mib_mean": _mean(self.pss_mib), "pss_mib_peak": round(max(self.pss_mib, default=0), 1),
            "driver_cpu_pct_of_core": round(100 * own_s / wall_s, 1),
            "others_pct_of_machine": round(100 * max(0.0, busy_s - cpu_s - own_s) / machine_s, 1),
            "steal_pct_of_machine": round(100 * steal_s / machine_s, 1), "loadavg": os.getloadavg(),
        }  # fmt: skip


def _mean(values: Sequence[float]) -> float | None:
    return round(float(np.mean(values)), 1) if values else None


# --- what came of what was sent ---


def quantiles(values: Sequence[float] | Vector) -> dict[str, float] | None:
    """Return median, 95 and 99 % and the largest of some values; None without."""
    if not len(values):
        return None
    found = np.percentile(values, [50, 95, 99, 100]).tolist()
    return dict(zip(("p50", "p95", "p99", "max"), (round(x, 2) for x in found), strict=True))


def partners(rover_s: Vector, base_s: Vector, plan: Plan, sent: Sent) -> Vector:
    """Return per rover epoch the moment at which the matching base epoch was sent, NaN without; the times are those of the logs."""
    partner = np.full(plan.count, np.nan)
    for j, stamp in sent.base.items():
        apart_s = np.abs(rover_s[plan.index] - base_s[j])
        k = int(np.argmin(apart_s))
        if apart_s[k] < 0.3 * plan.spacing and np.isnan(partner[k]):
            partner[k] = stamp
    return partner


class Tally:
    """What the solutions of one target come to, over all of its instances."""

    def __init__(self, plan: Plan, sent: Sent, partner: Vector, truth: Sequence[float] | None = None) -> None:
        self.plan, self.sent, self.partner, self.truth = plan, sent, partner, truth
        self.by_q = collections.Counter[int]()
        self.ages, self.latency, self.latency_from_both, self.errors = list[float](), list[float](), list[float](), list[float]()
        self.age0, self.before, self.solved, self.in_time, self.duplicates, self.strangers, self.unordered = 0, 0, 0, 0, 0, 0, 0
        self.shares, self.firsts, self.missing = list[float](), list[float](), list[int]()

    def add_instance(self, mine: Sequence[Record], tow: Vector, counted: Sequence[int]) -> None:
        """Count the records of one instance: each solution belongs to the rover epoch that is nearest by its time of week."""
        if mine:
            self.firsts.append(min(r.moment for r in mine))
        seen = self._by_epoch(mine, tow)
        for k in counted:
            if k in seen:
                self._add(seen[k], k)
            elif len(self.missing) < _KEPT:
                self.missing.append(k)
        solved = sum(k in seen for k in counted)
        self.solved += solved
        self.shares.append(solved / len(counted))

    def _by_epoch(self, mine: Sequence[Record], tow: Vector) -> dict[int, Record]:
        seen, previous = dict[int, Record](), -1
        for r in sorted(mine, key=lambda r: r.moment):
            apart_s = np.abs(_apart(tow % 86400, r.tow[1], 86400.0) if isinstance(r.tow, tuple) else _apart(tow, r.tow, WEEK))
            k = int(np.argmin(apart_s))
            if apart_s[k] > 0.4 * self.plan.spacing or np.isnan(self.sent.rover[k]):
                self.strangers += 1
            elif k in seen:
                self.duplicates += 1
            else:
                seen[k] = r
                self.unordered += k < previous
                previous = max(previous, k)
        return seen

    def _add(self, r: Record, k: int) -> None:
        self.by_q[r.q] += 1
        self.latency.append((r.moment - self.sent.rover[k]) * 1e3)
        self.in_time += self.latency[-1] <= self.plan.interval * 1e3
        both_s = r.moment - np.nanmax([self.sent.rover[k], self.partner[k]])
        if both_s < 0:
            self.before += 1
        else:
            self.latency_from_both.append(both_s * 1e3)
        if not np.isnan(r.age_s):
            self.ages.append(r.age_s / self.plan.spacing)
            self.age0 += abs(self.ages[-1]) < 0.5
        if self.truth is not None and r.xyz is not None and r.q == 1:
            self.errors.append(float(np.linalg.norm(np.subtract(r.xyz, self.truth))))

    def entry(self, instances: int, counted: int) -> Entry:
        """Return what it comes to of so many epochs for each instance."""
        n, ages, solved = counted * instances, self.ages, max(1, self.solved)
        entry: Entry = {
            "instances": instances, "epochs": n, "solved_pct": round(100 * self.solved / n, 2),
            "in_time_pct": round(100 * self.in_time / n, 2), "age0_pct": round(100 * self.age0 / n, 2),
            "worst_instance_pct": round(100 * min(self.shares), 2),
            "q_pct": {str(q): round(100 * c / solved, 1) for q, c in sorted(self.by_q.items())},
            "latency_ms": quantiles(self.latency), "latency_from_both_ms": quantiles(self.latency_from_both),
            "before_base_pct": round(100 * self.before / solved, 1), "age_epochs": quantiles(np.abs(ages)) if ages else None,
            "age_hist": {str(a): c for a, c in sorted(collections.Counter(round(a) for a in ages).items())[:40]},
            "duplicates": self.duplicates, "unmatched": self.strangers, "out_of_order": int(self.unordered),
            "missing_first": self.missing,
        }  # fmt: skip
        return entry | ({"fixed_error_m": quantiles(self.errors)} if self.errors else {})


def _apart(times: Vector, time_s: float, period_s: float) -> Vector:
    """Return by how much times are later than one, around the clock."""
    return (times - time_s + period_s / 2) % period_s - period_s / 2


def after_outages(accepted: dict[str, Sequence[float]], records: Sequence[Record], sent: Sent, spacing: float) -> list[Entry]:
    """Return how soon clients, solutions and solutions of age 0 came back after each outage; ``accepted``: moments of clients by feed."""
    out = list[Entry]()
    for feed, up in sent.ups:
        clients = sorted(moment - up for moment in accepted[feed] if moment >= up)
        after = [r for r in records if r.moment > up]
        new = [r.moment - up for r in after if abs(r.age_s) < 0.5 * spacing]
        out.append({
            "feed": feed, "reconnects_s": [round(a, 2) for a in clients[:4]],
            "next_solution_s": round(min(r.moment - up for r in after), 2) if after else None,
            "next_age0_s": round(min(new), 2) if new else None,
        })  # fmt: skip
    return out


def starts(target: Any, firsts: Sequence[float]) -> Entry:
    """Return how long a target took from its start to its first solutions."""
    if not firsts or not target.started:
        return {}
    return {
        "spawn_to_first_solution_s": round(min(firsts) - min(target.started), 3),
        "spawn_to_last_first_s": round(max(firsts) - min(target.started), 3), "ready_s": round(target.ready - target.started[0], 3),
    }  # fmt: skip
