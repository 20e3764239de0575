"""``rtkmesh warm``: all kernels into the cache, by running the engine once on simulated receivers."""

import importlib
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rtkmesh_services.cli.network import EXIT_OK, Json
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.runtime.kernel_cache import forget_old, use_kernel_cache

if TYPE_CHECKING:
    from rtkmesh.codecs.messages import Message
    from rtkmesh.rtk.options import Mode

ANTENNAS: Final = ("rover", "heading", "base")
# Two epochs of RINEX 3, of which one has a loss of lock: enough for every kernel of the reader.
_RINEX: Final = """\
     3.04           OBSERVATION DATA    M                   RINEX VERSION / TYPE
G    4 C1C L1C D1C S1C                                      SYS / # / OBS TYPES
  2026     1     1     0     0    0.0000000     GPS         TIME OF FIRST OBS
                                                            END OF HEADER
> 2026 01 01 00 00  0.0000000  0  2
G01  20000000.123   105000000.123 7     -1000.123          45.000
G02  21000000.123   110000000.12317      1000.123          40.000
> 2026 01 01 00 00  1.0000000  0  1
G01  20000000.123   105000000.123 7     -1000.123          45.000
"""


class Kernels(msgspec.Struct, frozen=True):
    """How the engine's kernels stand: compiled now, loaded from the cache. Kernels inside other kernels do not count."""

    compiled: int
    loaded: int


def warm(*, as_json: Json = False) -> int:
    """Compile the engine's kernels into the cache, so that every later start takes seconds instead of a minute.

    Services do this by themselves when they start (state WARMING); an image or an installer does it once for all.
    """
    began = time.monotonic()
    with _progress(quiet=as_json) as step:
        for name, action in steps():
            step(name)
            action()
    kernels = kernel_counts()
    forget_old(use_kernel_cache())
    took_s = time.monotonic() - began
    if as_json:
        sys.stdout.write(msgspec.json.encode({**msgspec.to_builtins(kernels), "seconds": round(took_s, 2)}).decode() + "\n")
    else:
        sys.stdout.write(f"{kernels.compiled} kernels compiled, {kernels.loaded} from the cache, in {took_s:.1f} s\n")
    return EXIT_OK


def steps() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield what is to be run, with its name; what comes first is needed by what follows."""
    yield "imports", _import_engine
    from rtkmesh.rtk.options import Mode
    from rtkmesh_services.solver.warming import simulated_messages, slowed, solve

    messages: dict[str, list[Message]] = {}

    def decode(antenna: str) -> None:
        messages[antenna] = simulated_messages(antenna)

    def run(mode: "Mode", rover: str, base: str) -> None:
        solve(mode, messages[rover], messages[base])

    for antenna in ANTENNAS:
        yield f"receiver {antenna}", lambda antenna=antenna: decode(antenna)
    for mode in (mode for mode in Mode if mode is not Mode.FIXED):  # which needs a position and has no kernel of its own
        pair = ("heading", "rover") if mode is Mode.MOVING_BASE else ("rover", "base")
        yield f"mode {mode.value}", lambda mode=mode, pair=pair: run(mode, *pair)
    yield "a slow base", lambda: solve(Mode.KINEMATIC, messages["rover"], slowed(messages["base"]))
    yield "what is rare", _warm_services
    yield "RTCM 3 legacy messages", _read_legacy
    yield "RINEX", _read_and_write_rinex
    yield "streets and forests", _simulate_surroundings


def kernel_counts() -> Kernels:
    """Return how many kernels this process has compiled and loaded (0 with NUMBA_DISABLE_JIT=1)."""
    kernels = {
        id(kernel): kernel for name, module in list(sys.modules.items()) if name.startswith("rtkmesh.") for kernel in _kernels_of(module)
    }
    compiled = sum(1 for kernel in kernels.values() if kernel.stats.cache_misses)
    loaded = sum(1 for kernel in kernels.values() if kernel.stats.cache_hits and not kernel.stats.cache_misses)
    return Kernels(compiled, loaded)


def _kernels_of(module: object) -> list[Any]:
    return [value for value in vars(module).values() if hasattr(value, "py_func") and hasattr(value, "stats")]


def _import_engine() -> None:
    importlib.import_module("rtkmesh_services.solver.warming")  # the whole engine comes with it


def _read_legacy() -> None:
    from rtkmesh.codecs.rtcm3_encode import frame
    from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
    from rtkmesh_services.solver.warming import START

    decoder = StreamDecoder(StreamOptions(approximate_time=START))
    one_satellite = (1004 << 52 | 3_600_000 << 10 | 1 << 4).to_bytes(8, "big") + (7 << 122).to_bytes(16, "big")
    decoder.feed(frame(one_satellite))
    decoder.flush()


def _warm_services() -> None:
    from rtkmesh_services.attitude.warming import warm_body, warm_choice
    from rtkmesh_services.ingest.warming import warm_decoder
    from rtkmesh_services.solver.warming import warm_engine

    warm_engine()
    warm_decoder()
    warm_body()
    warm_choice()


def _read_and_write_rinex() -> None:
    from rtkmesh.codecs.rinex_observation import ObservationReader
    from rtkmesh.codecs.rinex_observation_write import Equipment, ObservationWriter, Survey
    from rtkmesh.codecs.rinex_write import Origin

    survey, epochs = Survey(), list(ObservationReader(_RINEX))
    for epoch in epochs:
        survey.add(epoch)
    ObservationWriter(survey, Origin(3.05, "rtkmesh", datetime.now(UTC)), Equipment()).epoch(epochs[0])


def _simulate_surroundings() -> None:
    import numpy as np

    from rtkmesh.simulation.surroundings import VIEW, city, forest

    for view in (city(1, 15.0), forest(1, 0.5)):
        view(np.zeros(3), np.zeros(3), np.zeros(1), np.ones(1), np.empty((1, VIEW)))


def _progress(*, quiet: bool) -> AbstractContextManager[Callable[[str], None]]:
    """Return a function that is told each step: a live line on a terminal, plain lines elsewhere, on stderr."""
    if quiet:
        return nullcontext(_say_nothing)
    return _LiveLine() if sys.stderr.isatty() else nullcontext(_say)


def _say_nothing(name: str) -> None:
    """Take a step's name and be quiet."""


def _say(name: str) -> None:
    sys.stderr.write(f"{name}\n")


class _LiveLine:
    """A spinner with the present step."""

    def __enter__(self) -> Callable[[str], None]:
        from rich.console import Console

        self._status = Console(stderr=True).status("warming")
        self._status.start()
        return lambda name: self._status.update(f"warming: {name}")

    def __exit__(self, *_: object) -> None:
        self._status.stop()


app = command_page(
    warm,
    """
    rtkmesh warm
    NUMBA_CACHE_DIR=/opt/rtkmesh/kernels rtkmesh warm --json
    """,
)
