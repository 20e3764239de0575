"""Coverage-guided fuzzing with atheris: ``python -m tests.fuzz.guided NAME [-runs=100000] [CORPUS]``; without NAME: the names.

It sees the branches of Python code: the decoders of NMEA, stations, ephemerides and epochs, RINEX, ANTEX, NTRIP, commands. Kernels run as
plain Python (NUMBA_DISABLE_JIT), so that it sees theirs too: slow, but every branch counts. Checksums are made right before a frame is
fed, so that mutations reach the decoders. What it finds becomes a row of ``test_hostile_shapes.py``.
"""

import os
import sys
from itertools import islice
from pathlib import Path
from typing import Final

os.environ["NUMBA_DISABLE_JIT"] = "1"

import atheris

with atheris.instrument_imports(include=["rtkmesh", "rtkmesh_schemas", "rtkmesh_services"]):
    from tests.fuzz.frame_targets import PROTOCOLS
    from tests.fuzz.targets import all_targets

    import rtkmesh_services.ingest.service  # noqa: F401

_SEEDS: Final = 100


def main() -> int:
    """Fuzz one target until it is told to stop."""
    targets = {target.name: target for target in all_targets()}
    if len(sys.argv) < 2 or sys.argv[1] not in targets:
        sys.stdout.write(" ".join(targets) + "\n")
        return 2
    target, seal = targets[sys.argv.pop(1)], None
    for framed in PROTOCOLS:
        if framed.protocol.value == target.name:
            seal = framed.seal
    corpus = Path(".fuzz") / target.name
    _begin(corpus, target.pieces(1) if seal is None else iter(next(framed for framed in PROTOCOLS if framed.seal is seal).pool()))

    def one(data: bytes) -> None:
        if len(data) >= 2:
            target.make().feed(data if seal is None else seal(data[:1000]))

    atheris.Setup([*sys.argv, str(corpus)], one)
    atheris.Fuzz()
    return 0


def _begin(corpus: Path, seeds: object) -> None:
    """Give it something to begin with."""
    corpus.mkdir(parents=True, exist_ok=True)
    for number, piece in enumerate(islice(seeds, _SEEDS)):  # type: ignore[call-overload]
        (corpus / f"seed{number}").write_bytes(piece)


if __name__ == "__main__":
    sys.exit(main())
