"""Kernels that come from the disk: their intermediate code is read when another kernel is compiled with them, and not before."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="without compilation nothing is loaded")

KERNELS = """
from rtkmesh._jit import kernel


@kernel
def doubled(values):
    return 2.0 * values


@kernel
def doubled_again(values):
    return doubled(doubled(values))
"""

PROGRAM = """
import sys

import numpy as np

sys.path.insert(0, sys.argv[1])
import kernels


def state():
    (compiled,) = kernels.doubled.overloads.values()
    return "loaded" if kernels.doubled.stats.cache_hits else "compiled", compiled.library._kept is not None


one = np.ones(2)
print(kernels.doubled(one).tolist(), *state())
if len(sys.argv) > 2:
    print(kernels.doubled_again(one).tolist(), *state())
"""


def run(folder: Path, *arguments: str) -> list[str]:
    """Run the program in a process of its own; return what it says."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache")}
    argv = [sys.executable, "-c", PROGRAM, str(folder), *arguments]
    return subprocess.run(argv, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()


def test_intermediate_code_is_read_when_a_kernel_is_compiled_with_it(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS)
    assert run(tmp_path) == ["[2.0, 2.0] compiled False"]
    assert run(tmp_path) == ["[2.0, 2.0] loaded True"]
    assert run(tmp_path, "more") == ["[2.0, 2.0] loaded True", "[4.0, 4.0] loaded False"]
    assert run(tmp_path, "more") == ["[2.0, 2.0] loaded True", "[4.0, 4.0] loaded True"]
