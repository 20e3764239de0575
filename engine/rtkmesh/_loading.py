"""Compiled kernels from the disk, without their intermediate code.

Numba keeps a kernel as machine code and as the intermediate code that it was made of. The second one is only for kernels that are compiled
later and call this one; but numba reads it, and the names in it, whenever it loads a kernel. Here it is read when somebody asks for it.
"""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# ... numba's own types are known in part

from typing import Any

from llvmlite import binding
from numba.core import codegen

_codegen: Any = codegen
_binding: Any = binding


class _Loaded(_codegen.JITCodeLibrary):
    """The code of one kernel; ``_kept`` is its intermediate code as long as nobody has asked for it."""

    _kept: bytes | None = None

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, data = state
        if kind != "object":
            return super()._unserialize(codegen, state)
        library = codegen.create_library(name)
        library.enable_object_caching()
        library._set_compiled_object(data[0])  # noqa: SLF001
        library._kept = data[1]  # noqa: SLF001
        library._finalize_final_module()  # noqa: SLF001
        return library

    def _get_module_for_linking(self) -> Any:
        if self._kept is not None:
            self._shared_module, self._kept = _binding.parse_bitcode(self._kept), None
            self._codegen._engine._load_defined_symbols(self._shared_module)  # noqa: SLF001
        return super()._get_module_for_linking()

    def get_pointer_to_function(self, name: str) -> int:
        """Return where a function is in memory; numba's own method looks for its name in the intermediate code first."""
        if self._kept is None:
            return super().get_pointer_to_function(name)
        return self._codegen._engine.get_function_address(name)  # noqa: SLF001


def load_machine_code_alone() -> None:
    """Let numba load kernels so."""
    _codegen.JITCPUCodegen._library_class = _Loaded  # noqa: SLF001
