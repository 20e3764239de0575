"""Kernels as Python calls them: whole when they are asked for, loaded without numba's compiler, arrays given back without a pickle."""

import os
import subprocess
import sys
from pathlib import Path
from threading import Barrier, Thread

import numpy as np
import pytest
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="without compilation there are no dispatchers")

Vector = NDArray[np.float64]

KERNELS = """
import numpy as np

from rtkmesh._jit import kernel, kernel_in_place, scratch


@kernel_in_place
def add(values, more):
    room = scratch(1)
    room[0] = more
    for k in range(len(values)):
        values[k] += room[0]


@kernel
def raised(values, by=2.0):
    out = values.copy()
    add(out, by)
    return out, np.full((2, 2), by)
"""

PROGRAM = """
import sys

import numpy as np

sys.path.insert(0, sys.argv[1])
import kernels

one, table = kernels.raised(np.ones(2))
parts_of_compiler = ("numba.core.boxing", "numba.np.arrayobj", "numba.cpython.printimpl")
print(one.tolist(), table.tolist(), *(name in sys.modules for name in parts_of_compiler))
print(kernels.raised(np.ones(2), by=3.0)[0].tolist(), kernels.raised(np.ones(2), 4.0)[0].tolist())
print("_compiler" in vars(kernels.raised), "_compiler" in vars(kernels.add))
more = np.ones(1)
kernels.add(more, 1.0)
print(more.tolist(), kernels.raised(np.ones(3, np.float32))[0].tolist())
"""


def run(folder: Path) -> list[str]:
    """Run the program in a process of its own; return what it says."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache")}
    argv = [sys.executable, "-c", PROGRAM, str(folder)]
    return subprocess.run(argv, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()


def test_loaded_kernels_need_no_compiler_until_there_is_something_to_compile(tmp_path: Path) -> None:
    """The first process compiles; the second one loads, makes only what it calls whole, and compiles what is asked for in another type."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    called = ["[3.0, 3.0] [[2.0, 2.0], [2.0, 2.0]] {0} {0} {0}", "[4.0, 4.0] [5.0, 5.0]", "True {0}", "[2.0] [3.0, 3.0, 3.0]"]
    assert run(tmp_path) == [line.format(True) for line in called]
    assert run(tmp_path) == [line.format(False) for line in called]


@kernel_in_place
def doubled(values: Vector) -> None:
    for k in range(len(values)):
        values[k] *= 2.0


@kernel
def several(count: int) -> tuple[Vector, Vector, Vector]:
    """Return three arrays."""
    return np.zeros(count), np.ones(count), np.full(count, 2.0)


def test_a_kernel_tells_of_its_function() -> None:
    told = (several.__name__, several.__doc__, several.__module__, several.__qualname__)
    assert told == ("several", "Return three arrays.", __name__, "several")


def test_threads_that_call_a_kernel_first_at_once_all_get_it() -> None:
    together, values = Barrier(8), np.ones((8, 5))

    def call(row: Vector) -> None:
        together.wait()
        doubled(row)

    threads = [Thread(target=call, args=(row,)) for row in values]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (values == 2.0).all()


def test_arrays_are_given_back_without_asking_for_their_class() -> None:
    """Numba's own way unpickles it for each array, and keeps a reference to it each time."""
    several(3)
    before = sys.getrefcount(np.ndarray)
    for _ in range(1000):
        zeros, ones, _ = several(3)
        assert (zeros[0], ones[0]) == (0.0, 1.0)
    assert sys.getrefcount(np.ndarray) < before + 100
