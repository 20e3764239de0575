"""The one place where kernels are compiled.

Kernels are module-level functions of explicit loops over contiguous float64/int arrays. ``NUMBA_DISABLE_JIT=1`` runs
the same code as plain Python.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from rtkmesh._borrowing import BorrowingCompiler

F = TypeVar("F", bound=Callable[..., Any])

_Compile = Callable[[Callable[..., Any]], Callable[..., Any]]

_njit: Callable[..., _Compile] = cast("Any", numba.njit)  # its stub does not know ``_nrt``
_compile = _njit(cache=True, nogil=True, error_model="numpy", _nrt=True, pipeline_class=BorrowingCompiler)
_compile_in_place = _njit(cache=True, nogil=True, error_model="numpy", _nrt=False)


def kernel(function: F) -> F:
    """Compile ``function`` with numba: cached on disk, without the GIL, IEEE division; arrays that it is given are borrowed."""
    return cast("F", _compile(function))


def kernel_in_place(function: F) -> F:
    """Compile a kernel that makes no array, returns none, and calls no kernel that returns one: with what it is given it does
    not count references.

    What makes an array in here does not compile; what is returned to here would never be freed (``tests/rtk/test_kernels_in_place.py``).
    """
    return cast("F", _compile_in_place(function))
