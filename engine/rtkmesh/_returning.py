"""Arrays on their way back to Python.

For each of them numba asks Python for the class of arrays by its pickled form, 0.3 us; here it is at hand, among the kernel's constants.
"""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# ... numba's own types are known in part

import importlib
from functools import cache
from typing import Any, cast

from numba.core import pythonapi, types

_boxers: Any = pythonapi
_types: Any = types


def _returned(kind: Any, value: Any, crossing: Any) -> Any:
    """Write the code that makes a Python array of a kernel's, as numba does, but for where its class comes from."""
    from numba.core import boxing  # noqa: PLC0415  7 ms that only who compiles needs

    api, as_numba_does = crossing.pyapi, cast("Any", boxing).box_array

    def constant(thing: object) -> Any:
        return crossing.env_manager.read_const(crossing.env_manager.add_const(thing))

    api.serialize_object, api.unserialize = _itself, constant
    try:
        return as_numba_does(kind, value, crossing)
    finally:
        del api.serialize_object, api.unserialize


def _itself(thing: object) -> object:
    return thing


@cache
def return_arrays_sooner() -> None:
    """Let numba write that code into all kernels that it compiles from now on."""
    importlib.import_module("numba.core.boxing")  # which says how numba does it, and must come first
    _boxers._boxers.functions[_types.Array] = _returned  # noqa: SLF001
