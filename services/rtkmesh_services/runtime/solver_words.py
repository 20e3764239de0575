"""RTKRCV's words that a process does not have: which solver has them."""

from typing import Final

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.keys import Role
from rtkmesh_services.runtime.service import Context

SOLVER_WORDS: Final = frozenset({
    "start", "stop", "restart", "load", "save", "set", "option", "mode", "mark", "solution", "satellite", "observ", "navidata", "stream",
})  # fmt: skip


def solver_of(word: str, context: Context) -> str:
    """Return where a word is to be asked that only solvers have; nothing for other words, and where there is no solver."""
    solvers = _near(context.deployment, context.role, context.id) or list(context.deployment.solver)
    if word not in SOLVER_WORDS or context.role is Role.SOLVER or not solvers:
        return ""
    return f"{word} is a word of solvers: ask {' or '.join(solvers[:8])}"


def _near(deployment: Deployment, role: Role, id: str) -> list[str]:  # noqa: A002  the word of the design
    """Return the solvers that a process works with."""
    if role is Role.OUTPUT or role is Role.ATTITUDE:
        table = (deployment.output if role is Role.OUTPUT else deployment.attitude).get(id)
        return [] if table is None or not table.solver else [table.solver]
    return [name for name, table in deployment.solver.items() if id in (table.rover, table.base, *table.navigation)]
