"""The one place where kernels are compiled.

Kernels are module-level functions of explicit loops over contiguous float64/int arrays. ``NUMBA_DISABLE_JIT=1`` runs
the same code as plain Python.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_compile: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(cache=True, nogil=True, error_model="numpy")


def kernel(function: F) -> F:
    """Compile ``function`` with numba: cached on disk, without the GIL, IEEE division."""
    return cast("F", _compile(function))
