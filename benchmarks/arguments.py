"""Arguments that the benchmarks of simulated runs have in common."""

import argparse
import os


def parser_of(text: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help is the text of a program as it is written."""
    return argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)


def add_runs(parser: argparse.ArgumentParser, runs: str, quick: str, *, seed: int = 1) -> None:
    """Add how many runs, of which seed, in how many processes, and how to print; ``runs`` and ``quick`` say what these are of."""
    parser.add_argument("--runs", type=int, default=0, help=runs)
    parser.add_argument("--seed", type=int, default=seed)
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")


def add_data_unused(parser: argparse.ArgumentParser) -> None:
    """Add the folder of recordings that ``run.py`` gives every benchmark, to one that needs none."""
    parser.add_argument("--data", help="not needed: everything is simulated")
