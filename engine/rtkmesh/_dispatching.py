"""What stands for a kernel in Python: numba's dispatcher, which becomes whole when it is asked for, and loads without numba's compiler.

Of some six hundred kernels Python calls a few dozen, a program fewer; the others are part of the machine code of those. So a dispatcher
begins with the names of its arguments alone, and gets the rest (signature, compiler, folder on the disk) when it is first called or
compiled with another. And numba makes its compiler ready, with all functions that it knows, before it looks on the disk; here it does so
when it has to compile.
"""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# ... numba's own types are known in part

from collections.abc import Callable
from functools import cache
from typing import Any, cast

from llvmlite import binding
from numba import _dispatcher
from numba.core import caching, compiler_lock, dispatcher, registry
from numba.core.runtime import nrt
from numba.core.typeconv.rules import default_type_manager

from rtkmesh._returning import return_arrays_sooner

_binding: Any = binding
_caching: Any = caching
_dispatchers: Any = dispatcher
_registry: Any = registry
_runtime: Any = cast("Any", nrt)._nrt  # noqa: SLF001
_types: Any = default_type_manager
_lock: Any = compiler_lock.global_compiler_lock
_in_c: Any = _dispatcher


@cache
def _make_runtime_known() -> None:
    """Tell the loader where numba's own functions are that count references and make arrays, as numba's compiler does when it begins."""
    for name, address in _runtime.c_helpers.items():
        _binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


class _Form(_caching.CompileResultCacheImpl):
    """How a kernel is written to the disk: without the environments of other kernels in it that have no Python object in them.

    Loading each takes 50 us, and the modules of numba that they are of 20 ms.
    """

    def reduce(self, data: Any) -> Any:
        *parts, environments = cast("tuple[Any, ...]", super().reduce(data))
        return (*parts, tuple(one for one in environments if one.consts))


class _Kept(_caching.FunctionCache):
    """A kernel on the disk, loaded without numba's compiler; where it is not there it is about to be compiled."""

    _impl_class = _Form

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        _make_runtime_known()
        with self._guard_against_spurious_io_errors():
            found = self._load_overload(sig, target_context)
        if found is None:
            return_arrays_sooner()
        return found


class KernelDispatcher(_registry.CPUDispatcher):
    """One kernel, as Python calls it."""

    def __init__(self, py_func: Callable[..., Any], *asked: Any, **options: Any) -> None:
        self._asked = asked, options
        self.py_func, self.__doc__, self.__module__ = py_func, py_func.__doc__, py_func.__module__
        names = py_func.__code__.co_varnames[: py_func.__code__.co_argcount]
        defaults = tuple(_dispatchers.OmittedArg(value) for value in py_func.__defaults__ or ())
        _in_c.Dispatcher.__init__(self, _types.get_pointer(), len(names), True, names, defaults, False, False, False)

    def __getattr__(self, name: str) -> Any:
        with _lock:
            if begun := self.__dict__.pop("_asked", None):
                super().__init__(self.py_func, *begun[0], **begun[1])
                self._cache = _Kept(self.py_func)
        return object.__getattribute__(self, name)

    def _compilation_chain_init_hook(self) -> None:
        """Load no extensions of numba: its compiler does, when it begins."""
