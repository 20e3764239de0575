#!/usr/bin/env python3
"""What errors codes and phases of real receivers have, and those of the simulated classes beside them, by the same code.

  receiver_errors.py [--data DIR] [--seed S] [--quick] [--json]

Pairs: single differences of receivers that stand still, against a baseline that is known (their fixes, brought to what the phases
themselves say on average), without the clocks of each group of signals. Phases are modulo whole cycles, GLONASS left out; codes are as they
are, lasting biases included. Sigmas are of both receivers together. One receiver: code minus phase, free of the ionosphere by two bands,
about the mean of each arc: what lasts as long is not seen there.

Sigmas (codes m, phases mm) by ranges of elevation, degrees; autocorrelation by seconds apart: what is missing to 1 after one second is
white. At the end of a recording's length it falls below 0 where means were taken away.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import kernel_cache  # noqa: F401  first of all
from cases import data_folder, load
from code_minus_phase import of_receiver
from error_series import ELEVATIONS_DEG, LAGS_S, Series, describe
from pair_errors import Pair, of_pair, recorded_pair, simulated_pair
from results import table
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.simulation.classes import F9P, M8, SURVEY
from rtkmesh.simulation.receiver import ReceiverOptions
from rtkmesh_services.cli.recordings import open_recordings

Row = dict[str, Any]

# Pairs: what they are, the recorded ones, and the simulated classes beside them (rover, base).
PAIRS: Final = (
    ("survey and survey", ("tokyo_static_l125", "stromlo_l125", "kanagawa_60s", "geonet_2005"), (SURVEY, SURVEY)),
    ("M8 and survey", ("galway_a_glw1",), (M8, SURVEY)),
    ("M8 and M8", ("galway_a",), (M8, M8)),
    ("F9P and survey", (), (F9P, SURVEY)),
)
# Single receivers: name, file and others with navigation data, within the folder of the recordings.
RECEIVERS: Final = (
    (
        "survey",
        (
            ("tokyo rover", "tokyo_static/rover.obs", "tokyo_static/base.nav"),
            ("tokyo base", "tokyo_static/base.obs", "tokyo_static/base.nav"),
        ),
        SURVEY,
    ),
    (
        "F9P",
        (
            ("umea base", "umea_f9p/B001.ubx"),
            ("sdq 11:46", "sdq_f9p_2021/20210809-114636-ubx-nmea-data.ubx"),
            ("sdq 11:59", "sdq_f9p_2021/20210809-115907-ubx-nmea-data.ubx"),
            ("sdq 12:10", "sdq_f9p_2021/20210809-121012-ubx-nmea-data.ubx"),
            ("sdq 12:29", "sdq_f9p_2021/20210809-122906-ubx-nmea-data.ubx"),
            ("galway 2019", "galway_m8p/rover-20190416-1550.ubx.gz"),
        ),
        F9P,
    ),
)  # fmt: skip
SECONDS: Final = 600  # of a simulated run
RUNS: Final = 4
QUICK_PAIRS: Final = PAIRS[2:3]
COLUMNS: Final = ("data", "errors of", "number", *(f"{a:.0f} to {b:.0f}" for a, b in ELEVATIONS_DEG), *(f"{lag:.0f} s" for lag in LAGS_S))


def of_pairs(data: Path | None, seed: int, runs: int, pairs: Sequence[Any]) -> Iterator[Row]:
    """Yield the rows of recorded pairs, each kind followed by the simulated classes."""
    for title, names, (rover, base) in pairs:
        for case in load(data, list(names)) if data else []:
            yield from _rows(f"{case.name} ({title})", of_pair(recorded_pair(case)))
        yield from _rows(f"simulated: {title}", _together([of_pair(pair) for pair in _simulated(rover, base, seed, runs)]))


def of_receivers(data: Path | None, seed: int, runs: int) -> Iterator[Row]:
    """Yield the rows of single receivers, each class followed by the simulated one."""
    for title, files, receiver in RECEIVERS:
        for name, *paths in files if data else []:
            yield from _rows(f"{name} ({title})", {"code - phase": _recorded([data / path for path in paths])})
        found = [of_receiver(pair.rover, pair.navigation) for pair in _simulated(receiver, SURVEY, seed, runs)]
        yield from _rows(f"simulated: {title}", {"code - phase": [series for part in found for series in part]})


def _simulated(rover: ReceiverOptions, base: ReceiverOptions, seed: int, runs: int) -> Iterator[Pair]:
    return (simulated_pair(rover, base, SECONDS, seed + run) for run in range(runs))


def _recorded(paths: Sequence[Path]) -> list[Series]:
    streams = [list(recording.messages()) for recording in open_recordings(list(paths), None)]
    epochs = [message for message in streams[0] if isinstance(message, Epoch)]
    return of_receiver(epochs, [message for stream in streams for message in stream if not isinstance(message, Epoch)])


def _together(parts: Sequence[dict[str, list[Series]]]) -> dict[str, list[Series]]:
    return {kind: [series for part in parts for series in part[kind]] for kind in parts[0]}


def _rows(name: str, found: dict[str, list[Series]]) -> Iterator[Row]:
    for kind, series in found.items():
        if series:
            known = describe(series)
            yield {"data": name, "errors": kind, "number": known.number, "sigma_m": known.sigma_m, "correlation": known.correlation}


def _cells(row: Row) -> list[str]:
    scale, form = (1e3, ".1f") if row["errors"] == "phase" else (1.0, ".2f")
    sigmas = [format(scale * value, form) for value in row["sigma_m"]]
    return [row["data"], row["errors"], str(row["number"]), *sigmas, *(f"{value:.2f}" for value in row["correlation"])]


def page(rows: Sequence[Row]) -> str:
    """Return the table as Markdown; nothing where a recording cannot tell."""
    return table(COLUMNS, [[cell.replace("nan", "") for cell in _cells(row)] for row in rows])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="M8 pairs only, one simulated run")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    options = parser.parse_args()
    data = options.data or data_folder()
    if data is None:
        print("receiver_errors: no recordings (RTKMESH_DATA): simulation only", file=sys.stderr)
    rows = list(of_pairs(data, options.seed, 1 if options.quick else RUNS, QUICK_PAIRS if options.quick else PAIRS))
    if not options.quick:
        rows += of_receivers(data, options.seed, RUNS)
    print(json.dumps(rows, indent=1) if options.json else page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
