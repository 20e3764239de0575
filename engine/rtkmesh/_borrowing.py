"""Numba's compiler, but a kernel borrows what it is given instead of counting references to it.

Numba counts every array that a kernel is given when it begins and when it ends, and in between every field of a tuple and every row of
an array that gets a name: two atomic instructions each, a sixth of the time of an epoch of one band. But whoever calls a kernel keeps all
of that alive until it returns. So a name whose only value is an argument, or a part of one, needs no reference of its own. Numba's
translation into machine code stays as it is: beside each count of such a name its opposite is written, and numba takes both out.
"""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# ... numba's own types are known in part

from collections import Counter
from typing import Any

from numba.core import ir, types
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import register_pass
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering

_ir: Any = ir
_types: Any = types


class _Borrowing(Lower):
    """The translation of one kernel."""

    def lower(self) -> None:
        self._borrowed = borrowed_names(self)
        super().lower()

    def lower_assign(self, ty: Any, inst: Any) -> Any:
        value: Any = super().lower_assign(ty, inst)
        if inst.target.name in self._borrowed:
            self.decref(ty, value)
        return value

    def delvar(self, name: str) -> None:
        if name in self._borrowed:
            kind: Any = self.typeof(name)
            self._alloca_var(name, kind)
            self.incref(kind, self.loadvar(name))
        super().delvar(name)


def borrowed_names(lower: Any) -> set[str]:
    """Return the names of a kernel whose only value is one of its arguments or part of one."""
    assigned = [part for block in lower.blocks.values() for part in block.body if isinstance(part, _ir.Assign)]
    times = Counter(part.target.name for part in assigned)
    once = [part for part in assigned if times[part.target.name] == 1]
    known, found = set[str](), {part.target.name for part in once if isinstance(part.value, _ir.Arg)}
    while found > known:
        known = set(found)
        found |= {part.target.name for part in once if _is_part(lower, part.value, known)}
    return known


def _is_part(lower: Any, value: Any, borrowed: set[str]) -> bool:
    """Return whether a value is one that is borrowed, an item of it, or a view of an array."""
    if isinstance(value, _ir.Var):
        return value.name in borrowed
    if not isinstance(value, _ir.Expr) or value.op not in ("getattr", "static_getitem", "getitem") or value.value.name not in borrowed:
        return False
    whole = lower.typeof(value.value.name)
    return isinstance(whole, _types.BaseTuple) or (isinstance(whole, _types.Array) and value.op != "getattr" and _is_view(lower, value))


def _is_view(lower: Any, value: Any) -> bool:
    """Return whether an index gives a view of an array, not a copy."""
    if value.op == "static_getitem":
        fixed: tuple[Any, ...] = value.index if isinstance(value.index, tuple) else (value.index,)
        return all(isinstance(part, int | slice) for part in fixed)
    index = lower.typeof(value.index.name)
    parts = index.types if isinstance(index, _types.BaseTuple) else (index,)
    return all(isinstance(part, _types.Integer | _types.SliceType) for part in parts)


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(NativeLowering):
    """The step of numba's compiler that translates."""

    _name = "borrowing"

    @property
    def lowering_class(self) -> Any:
        return _Borrowing


class BorrowingCompiler(Compiler):
    """Numba's compiler with this step."""

    def define_pipelines(self) -> Any:
        pipelines: Any = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [(_Lowering if one is NativeLowering else one, what) for one, what in pipeline.passes]
            pipeline.finalize()
        return pipelines
