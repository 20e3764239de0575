"""RTKLIB demo5 (PyPI pyrtklib5) on one recording, in this process: processor time of every epoch's ``rtkpos``, as JSON.

Run it with ``python benchmarks/demo5_speed.py CASE [--data DIR] [--repeats N]``. Reading, pairing and copying of observations are not
timed. Epochs are paired as demo5's ``postpos`` does it, and of other systems than the case's no observation is passed on, as there.
"""

import argparse
import json
import tempfile
import time
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyrtklib5

import rtklib
from cases import Case, load

ROVER, BASE = 1, 2
SAME_EPOCH_S: Final = 0.025  # RTKLIB's DTTOL
FIXED: Final = 1


class Span(NamedTuple):
    """One receiver's epoch: its time and the indices of its observations."""

    time_s: float
    rows: list[int]


def options(case: Case) -> Any:
    """Return the processing options that lie beside the recording."""
    processing, solution, files = pyrtklib5.prcopt_t(), pyrtklib5.solopt_t(), pyrtklib5.filopt_t()
    pyrtklib5.resetsysopts()
    if not pyrtklib5.loadopts(str(rtklib.stored_options(case)), pyrtklib5.sysopts[0]):
        raise rtklib.ProgramError(f"{case.name}: demo5 does not read the options")
    pyrtklib5.getsysopts(processing, solution, files)
    return processing


def read(case: Case, folder: Path) -> tuple[Any, Any]:
    """Return observations and navigation data."""
    rover, base, *navigation_files = rtklib.rinex(case, folder)
    observations, navigation = pyrtklib5.obs_t(), pyrtklib5.nav_t()
    for receiver, file in ((ROVER, rover), (BASE, base), *((BASE, file) for file in navigation_files)):
        pyrtklib5.readrnx(str(file), receiver, "", observations, navigation, pyrtklib5.sta_t())
    pyrtklib5.uniqnav(navigation)
    pyrtklib5.sortobs(observations)
    return observations, navigation


def spans(observations: Any, allowed: set[int]) -> dict[int, list[Span]]:
    """Return the epochs of both receivers, without satellites that are not allowed."""
    found: dict[int, list[Span]] = {ROVER: [], BASE: []}
    for k in range(observations.n):
        row = observations.data[k]
        time_s, mine = row.time.time + row.time.sec, found[row.rcv]
        if not mine or time_s - mine[-1].time_s > SAME_EPOCH_S:
            mine.append(Span(time_s, []))
        if row.sat in allowed:
            mine[-1].rows.append(k)
    return found


def pairs(case: Case, observations: Any) -> Iterator[tuple[Any, int]]:
    """Yield the observations of each rover epoch, followed by those of the newest base epoch (the first, where none is older), and their
    number.
    """
    allowed = {pyrtklib5.satid2no(f"{system}{number:02d}") for system in case.systems for number in range(1, 64)}
    found = spans(observations, allowed)
    times_s = [span.time_s for span in found[BASE]]
    for span in found[ROVER]:
        before = max(0, bisect_right(times_s, span.time_s + SAME_EPOCH_S) - 1)
        rows = [*span.rows, *found[BASE][before].rows]
        block = pyrtklib5.Arr1Dobsd_t(len(rows))
        for place, row in enumerate(rows):
            block[place] = observations.data[row]
        yield block, len(rows)


def solve(epochs: list[tuple[Any, int]], navigation: Any, processing: Any) -> tuple[list[float], int]:
    """Return processor milliseconds of every epoch, and the number of fixes."""
    engine, used_ms, fixes = pyrtklib5.rtk_t(), list[float](), 0
    pyrtklib5.rtkinit(engine, processing)
    for block, count in epochs:
        begun = time.thread_time()
        pyrtklib5.rtkpos(engine, block[0], count, navigation)
        used_ms.append(1e3 * (time.thread_time() - begun))
        fixes += engine.sol.stat == FIXED
    pyrtklib5.rtkfree(engine)
    return used_ms, fixes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    (case,) = load(asked.data, [asked.case])
    with tempfile.TemporaryDirectory() as folder:
        observations, navigation = read(case, Path(folder))
        epochs = list(pairs(case, observations))
        runs = [solve(epochs, navigation, options(case)) for _ in range(asked.repeats)]
    best_ms = [min(epoch) for epoch in zip(*(used_ms for used_ms, _ in runs), strict=True)]
    print(json.dumps({"epochs": len(best_ms), "fixes": runs[0][1], "ms": best_ms}))


if __name__ == "__main__":
    main()
