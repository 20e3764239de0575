"""RTKRCV's screens that are shown again and again: published as text while somebody looks."""

from collections.abc import Callable
from typing import Final

from rtkmesh_schemas.keys import SCREEN
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.runtime.service import Context
from rtkmesh_services.solver.screens.solutions import SolutionForm, solutions_screen

PERIOD_NS: Final = 1_000_000_000
PERIODIC: Final = ("status", "satellite", "observ", "navidata", "stream")


class Broadcast:
    """Publishes ``rtk/{id}/screen/{word}``. ``screen`` makes the text of one of PERIODIC."""

    def __init__(self, context: Context, screen: Callable[[str], str]) -> None:
        self._context, self._screen = context, screen
        self._due_ns = 0
        self._told = 0

    def tick(self, now_mono_ns: int) -> None:
        """Publish what is due."""
        self._errors()
        if now_mono_ns < self._due_ns:
            return
        self._due_ns = now_mono_ns + PERIOD_NS
        for word in PERIODIC:
            if self._context.bus.matched(SCREEN, word=word):
                self._context.bus.publish(SCREEN, self._screen(word), word=word)

    def solved(self, solution: SolutionMessage) -> None:
        """Publish a solution's line."""
        if self._context.bus.matched(SCREEN, word="solution"):
            self._context.bus.publish(SCREEN, solutions_screen([solution], SolutionForm()), word="solution")

    def _errors(self) -> None:
        faults = self._context.faults
        news, self._told = faults.total - self._told, faults.total
        if news and self._context.bus.matched(SCREEN, word="error"):
            self._context.bus.publish(SCREEN, "".join(f"{fault.line}\n" for fault in faults.newest(news)), word="error")
