"""The one place where kernels are compiled, and where they get room to work in.

Kernels are module-level functions of explicit loops over contiguous float64/int arrays. ``NUMBA_DISABLE_JIT=1`` runs
the same code as plain Python.
"""

from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numpy as np
from numba.core import config, types
from numba.core.compiler import Compiler
from numba.extending import intrinsic
from numpy.typing import NDArray

from rtkmesh._borrowing import BorrowingCompiler
from rtkmesh._dispatching import KernelDispatcher
from rtkmesh._loading import load_machine_code_alone

load_machine_code_alone()

F = TypeVar("F", bound=Callable[..., Any])

_OPTIONS: Final = {"nopython": True, "nogil": True, "error_model": "numpy", "boundscheck": None}
_array, _intrinsic = cast("Any", types.Array), cast("Any", intrinsic)
_WITHOUT_JIT: Final[bool] = cast("Any", config).DISABLE_JIT
_ALIGN_BYTES: Final = 32


def kernel(function: F) -> F:
    """Compile ``function`` with numba: cached on disk, without the GIL, IEEE division; arrays that it is given are borrowed."""
    return _dispatched(function, BorrowingCompiler, counting=True)


def kernel_in_place(function: F) -> F:
    """Compile a kernel that makes no array but scratch, returns none, and calls no kernel that returns one: with what it is given it does
    not count references.

    What makes an array in here does not compile; what is returned to here would never be freed (``tests/rtk/test_kernels_in_place.py``).
    """
    return _dispatched(function, Compiler, counting=False)


def _dispatched(function: F, pipeline: type[Compiler], *, counting: bool) -> F:
    if _WITHOUT_JIT:
        return function
    return cast("F", KernelDispatcher(function, targetoptions={**_OPTIONS, "_nrt": counting}, pipeline_class=pipeline))


# --- room on the stack ---
# An array of the heap costs a kernel 45 ns, and its references are counted; one of the kernel's stack costs nothing and is gone when the
# kernel returns. So it must not be returned, nor made in a loop, nor be larger than some hundred kilobytes.


def _on_stack(context: Any, builder: Any, array_type: Any, sizes: Any) -> Any:
    """Write the code that makes an array of these sizes on the stack."""
    from numba.np import arrayobj  # noqa: PLC0415  20 ms that only who compiles needs

    arrays = cast("Any", arrayobj)
    number = context.get_data_type(array_type.dtype)
    count, strides = sizes[-1], [context.get_constant(types.intp, context.get_abi_sizeof(number))]
    if len(sizes) == 2:
        count, strides = builder.mul(sizes[0], sizes[1]), [builder.mul(sizes[1], strides[0]), strides[0]]
    data = builder.alloca(number, size=count)
    data.align = _ALIGN_BYTES
    array = arrays.make_array(array_type)(context, builder)
    arrays.populate_array(array, data=data, shape=sizes, strides=strides, itemsize=strides[-1], meminfo=None)
    return array._getvalue()  # noqa: SLF001  how numba's own array functions return theirs


def _maker(array_type: Any) -> Any:
    """Return what types and writes a call that makes such an array."""

    def code(context: Any, builder: Any, signature: Any, sizes: Any) -> Any:
        whole = [context.cast(builder, value, kind, types.intp) for value, kind in zip(sizes, signature.args, strict=True)]
        return _on_stack(context, builder, array_type, whole)

    return array_type(*[types.intp] * array_type.ndim), code


def _from_stack(dtype: Any, dimensions: int) -> Callable[[F], F]:
    """Let kernels take from the stack what a function of one or two sizes makes."""
    array_type = _array(dtype, dimensions, "C")

    def line(_context: Any, _count: Any) -> Any:
        return _maker(array_type)

    def table(_context: Any, _rows: Any, _columns: Any) -> Any:
        return _maker(array_type)

    def replace(function: F) -> F:
        return function if _WITHOUT_JIT else cast("F", _intrinsic(line if dimensions == 1 else table))

    return replace


@_from_stack(types.float64, 1)
def scratch(count: int) -> NDArray[np.float64]:
    """Return so many numbers, not set to anything, that are gone when the kernel returns."""
    return np.empty(count)


@_from_stack(types.float64, 2)
def scratch_table(rows: int, columns: int) -> NDArray[np.float64]:
    """Return a table of numbers, not set to anything, that is gone when the kernel returns."""
    return np.empty((rows, columns))


@_from_stack(types.int64, 1)
def scratch_indices(count: int) -> NDArray[np.int64]:
    """Return so many integers, not set to anything, that are gone when the kernel returns."""
    return np.empty(count, np.int64)


@_from_stack(types.int64, 2)
def scratch_index_table(rows: int, columns: int) -> NDArray[np.int64]:
    """Return a table of integers, not set to anything, that is gone when the kernel returns."""
    return np.empty((rows, columns), np.int64)


@_from_stack(types.boolean, 1)
def scratch_flags(count: int) -> NDArray[np.bool_]:
    """Return so many truth values, not set to anything, that are gone when the kernel returns."""
    return np.empty(count, np.bool_)
