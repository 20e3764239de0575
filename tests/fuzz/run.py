"""Run all targets for long: ``python -m tests.fuzz.run --pieces 10_000_000 --seed 1 [--only NAME]``. Exit code 1 when one fails."""

import argparse
import gc
import sys

from rtkmesh_services.runtime.kernel_cache import use_kernel_cache

use_kernel_cache()


def main() -> int:
    """Run and print a line for each target."""
    from tests.fuzz.harness import run
    from tests.fuzz.targets import all_targets

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pieces", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    chosen = [target for target in all_targets() if options.only in (target.name, "")]
    total, failed = sum(target.share for target in chosen), 0
    for target in chosen:
        run(target, 300, seed=10**6)  # imports and kernels
        gc.freeze()
        outcome = run(target, round(options.pieces * target.share / total), options.seed)
        print(outcome.row, *(failure[:2000] for failure in outcome.failures), sep="\n    ", flush=True)
        failed += bool(outcome.failures)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
