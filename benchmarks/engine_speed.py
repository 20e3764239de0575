"""CPU time per epoch of the engine on recordings (decoding left out), and of its stages; then, on all recordings, beside RTKLIB's.

Run it with ``python benchmarks/engine_speed.py [--data DIR] [--only NAME,...]``; ``--only`` names recordings of the comparison.

The first epochs (compilation, cold caches) are not counted.
"""

import argparse
import time
from bisect import bisect_right
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

import numpy as np

import kernel_cache  # noqa: F401  first of all
import rtklib
import solver_speed
from cases import data_folder, load
from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk import engine as engine_module
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.solution import Status

CASES = (
    ("tokyo 1 band G", "tokyo_static", "rover.obs", "base.obs", "base.nav", (-3817680.7270, 3562839.5216, 3650159.2407), "G", 1),
    ("tokyo 2 bands GEJC", "tokyo_static", "rover.obs", "base.obs", "base.nav", (-3817680.7270, 3562839.5216, 3650159.2407), "GEJC", 2),
    ("tokyo 3 bands GREJC", "tokyo_static", "rover.obs", "base.obs", "base.nav", (-3817680.7270, 3562839.5216, 3650159.2407), "GREJC", 3),
    (
        "kanagawa 2 bands GEJ", "kanagawa_2021_078_60s", "SEPT078M1.21O", "3034078M1.21O", "SEPT078M.21P",
        (-3959400.631, 3385704.533, 3667523.111), "GEJ", 2,
    ),
)  # fmt: skip
WARM = 5
STAGES = ("locate_epoch", "take_step", "report")  # the compiled calls of a step, and its last


def seconds(time_):
    return time_.week * 604800.0 + time_.tow_s


def read(folder, rover, base, nav):
    table = EphemerisTable()
    for ephemeris in read_navigation((folder / nav).read_bytes()).ephemerides:
        table.add(ephemeris)
    rovers, bases = (list(ObservationReader((folder / name).read_bytes())) for name in (rover, base))
    times = [seconds(epoch.time) for epoch in bases]
    return [(epoch, bases[bisect_right(times, seconds(epoch.time) + 0.025) - 1]) for epoch in rovers], table


def run(pairs, table, base_ecef_m, options):
    """Return CPU milliseconds per epoch after the first ones, the solutions, and of a second run the milliseconds of each stage."""
    engine, used, solutions = Rtk(options), [], []
    for rover, base in pairs:
        start = time.thread_time()
        solutions.append(engine.step(rover, base, table, base_position_ecef_m=base_ecef_m))
        used.append(1e3 * (time.thread_time() - start))
    return np.array(used[WARM:]), solutions, staged(pairs, table, base_ecef_m, options)


def staged(pairs, table, base_ecef_m, options):
    """Return the median milliseconds of each stage."""
    spent = {stage: [] for stage in STAGES}
    with ExitStack() as stack:
        for stage in STAGES:
            stack.enter_context(patch.object(engine_module, stage, solver_speed.timed(getattr(engine_module, stage), spent[stage])))
        engine = Rtk(options)
        for rover, base in pairs:
            engine.step(rover, base, table, base_position_ecef_m=base_ecef_m)
    return {stage: float(np.median(values)) for stage, values in spent.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=data_folder())
    parser.add_argument("--only", help="recordings of the comparison, by name")
    asked = parser.parse_args()
    stages_of_cases(asked.data)
    if not rtklib.missing():
        print()
        solver_speed.page(load(asked.data, asked.only and asked.only.split(",")), asked.data)


def stages_of_cases(data):
    """Print what an epoch costs, and its stages."""
    print("| case | epochs | satellites | ambiguities | fixed % | ms median | ms mean | ms p99 |")
    print("|---|---|---|---|---|---|---|---|")
    stages = {}
    for name, folder, rover, base, nav, base_ecef_m, systems, frequencies in CASES:
        pairs, table = read(data / folder, rover, base, nav)
        ms, solutions, stages[name] = run(pairs, table, np.array(base_ecef_m), RtkOptions(systems=systems, frequencies=frequencies))
        fixed = np.mean([s.status is Status.FIX for s in solutions]) * 100.0
        used, known = (np.median([getattr(s, column) for s in solutions]) for column in ("satellites_used", "ambiguities"))
        times = f"{np.median(ms):.2f} | {ms.mean():.2f} | {np.percentile(ms, 99):.2f}"
        print(f"| {name} | {len(pairs)} | {used:.0f} | {known:.0f} | {fixed:.1f} | {times} |")
    print("\n| stage, ms (median) | " + " | ".join(stages) + " |\n|---|" + "---|" * len(stages))
    for stage in STAGES:
        print(f"| {stage} | " + " | ".join(f"{stages[name][stage]:.3f}" for name in stages) + " |")


if __name__ == "__main__":
    main()
