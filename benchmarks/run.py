#!/usr/bin/env python3
"""All benchmarks, one after the other: `make bench`, or `make bench ARGS="--quick"`.

  run.py [--quick] [--only accuracy,campaign,...] [--markdown]

Most need the recordings (RTKMESH_DATA or ../shared/data), some simulate all they need; what is missing is said and left out. --markdown
writes the figures into benchmarks/RESULTS.md and the table of README.md. Ends with 1 when a benchmark failed.
"""

import argparse
import importlib.util
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import rtklib
from cases import data_folder
from results import RESULTS, fill, made

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A program of this folder.

    ``quick``: its arguments in a quick run; ``modules``: what it imports beyond rtkmesh's own needs; ``recordings``: it needs them.
    """

    name: str
    file: str
    title: str
    quick: tuple[str, ...] = ()
    modules: tuple[str, ...] = ()
    recordings: bool = True

    def obstacle(self) -> str:
        """Return why it cannot run, or nothing."""
        if not (HERE / self.file).is_file():
            return f"{self.file} is not there"
        if self.recordings and data_folder() is None:
            return "no recordings: set RTKMESH_DATA"
        missing = [name for name in self.modules if importlib.util.find_spec(name) is None]
        return f"not installed: {', '.join(missing)}" if missing else ""


PARSERS = ("pyubx2", "pyrtcm", "pysbf2", "pynmeagps")
BENCHMARKS = (
    Benchmark("accuracy", "accuracy.py", "Solutions beside RTKLIB's, per recording", ("--quick",)),
    Benchmark("campaign", "campaign.py", "Simulated runs against the truth", ("--quick",), recordings=False),
    Benchmark("rates", "rates.py", "The same runs at 1, 5 and 10 Hz", ("--quick",), recordings=False),
    Benchmark("modes", "modes.py", "Drawn configurations: where the engine is wrong", ("--quick",), recordings=False),
    Benchmark("stations", "stations.py", "Permanent stations 20 to 50 km apart for hours", ("--quick",), recordings=False),
    Benchmark("peers", "peers.py", "Runs of the campaign beside RTKLIB b34 and demo5", ("--quick",), recordings=False),
    Benchmark("troubles", "troubles.py", "Drawn surroundings and faults: where the engine is wrong", ("--quick",), recordings=False),
    Benchmark("dive", "dive.py", "After dives, RTKLIB on the same bytes", ("--quick",), recordings=False),
    Benchmark("directions", "directions.py", "Forward, backward and combined, beside RTKLIB's", ("--quick",)),
    Benchmark("thin_base", "thin_base.py", "A base every 5 to 30 s, interpolated or not, beside RTKLIB's", ("--quick",)),
    Benchmark("heading", "heading.py", "How a heading repeats, beside RTKLIB's", ("--quick",)),
    Benchmark("attitude_age", "attitude_age.py", "What an old base does to a heading, beside RTKLIB's", ("--quick",), recordings=False),
    Benchmark("attitude", "attitude.py", "Two, three and four simulated antennas against the truth", ("--quick",), recordings=False),
    Benchmark(
        "attitude_stages", "attitude_stages.py", "From the last byte to the attitude, as processes", ("--seconds", "10"), recordings=False
    ),
    Benchmark("attitude_filter", "attitude_filter.py", "Attitude filters: errors, honesty, outages", ("--quick",), recordings=False),
    Benchmark("four_antennas", "four_antennas.py", "Attitude of four antennas in motion, with faults", ("--quick",)),
    Benchmark("attitude_search", "attitude_search.py", "Attitude from single epochs with known geometry", ("--quick",), recordings=False),
    Benchmark("attitude_subsets", "attitude_subsets.py", "Single epochs of few satellites with the length known", ("--quick",)),
    Benchmark("sigmas", "sigmas.py", "Covariances against errors", ("--quick",)),
    Benchmark("receiver_errors", "receiver_errors.py", "Errors of codes and phases, recorded and simulated", ("--quick",)),
    Benchmark("slips", "slips.py", "Cycle slips: found, missed, and what these do", ("--quick",), recordings=False),
    Benchmark("integrity", "integrity.py", "Fix probabilities and protection levels against errors", ("--quick",)),
    Benchmark("endurance", "endurance.py", "A million updates of one filter", ("--quick",), recordings=False),
    Benchmark("decode", "decode_speed.py", "Decoders beside the Python parsers and convbin", ("--quick",), PARSERS),
    Benchmark("ingest", "ingest_load.py", "Four receivers at 20 Hz: what decoding and publishing cost", ("--quick",)),
    Benchmark("engine", "engine_speed.py", "The engine's steps, and an epoch beside RTKLIB's", modules=("pyrtklib5",)),
    Benchmark("ntrip", "ntrip.py", "NTRIP client and caster beside str2str", ("--quick",), recordings=False),
    Benchmark("commands", "commands.py", "Answers to commands while everything works", ("--quick",), recordings=False),
    Benchmark("realtime", "realtime.py", "A running deployment beside rtkrcv", ("--only", "base 60 ms late,cold start", "--seconds", "8")),
)


def main() -> int:
    options = _options()
    if rtklib.missing():
        print(f"RTKLIB is not installed ({', '.join(rtklib.missing())}): our own figures only (Debian package rtklib)")
    failed: list[str] = []
    for benchmark in BENCHMARKS:
        if options.only and benchmark.name not in options.only.split(","):
            continue
        print(f"\n== {benchmark.name}: {benchmark.title}", flush=True)
        if obstacle := benchmark.obstacle():
            print(f"left out: {obstacle}")
        elif not _run(benchmark, quick=options.quick, markdown=options.markdown):
            failed.append(benchmark.name)
    if failed:
        print(f"\nfailed: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


def _run(benchmark: Benchmark, *, quick: bool, markdown: bool) -> bool:
    """Run a benchmark, passing on what it prints; keep it for RESULTS.md if asked."""
    data = data_folder()
    argv = [sys.executable, str(HERE / benchmark.file), *(("--data", str(data)) if data else ()), *(benchmark.quick if quick else ())]
    own_pages = benchmark.name == "accuracy"  # writes its tables itself
    if markdown and own_pages:
        argv.append("--markdown")
    lines: list[str] = []
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            lines.append(line)
    if markdown and not own_pages and process.returncode == 0:
        fill(RESULTS, benchmark.name, f"{made()}\n\n{_page(''.join(lines).rstrip())}\n")
    return process.returncode == 0


def _page(text: str) -> str:
    """Return what a benchmark printed as part of a page: Markdown tables as they are, columns of text in a fence."""
    return text if text.startswith("|") else f"```text\n{text}\n```"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="minutes instead of an hour")
    parser.add_argument("--only", help=", ".join(benchmark.name for benchmark in BENCHMARKS))
    parser.add_argument("--markdown", action="store_true", help="write the figures into benchmarks/RESULTS.md and README.md")
    options = parser.parse_args()
    if options.quick and options.markdown:
        parser.error("--markdown is for the full run")
    unknown = set((options.only or "accuracy").split(",")) - {benchmark.name for benchmark in BENCHMARKS}
    if unknown:
        parser.error(f"there is no benchmark {', '.join(sorted(unknown))}")
    return options


if __name__ == "__main__":
    sys.exit(main())
