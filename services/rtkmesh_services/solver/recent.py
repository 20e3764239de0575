"""What a solver remembers for its words: the newest epochs, solutions and solver faults. Bounded."""

from collections import deque
from collections.abc import Sequence
from typing import Final

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.rtk.session import Source
from rtkmesh.rtk.solution import Reason, Solution, Status
from rtkmesh_schemas.solution import SolutionMessage

SOLUTIONS: Final = 256  # as RTKRCV keeps for its console


class Recent:
    """The newest of everything that went through a solver."""

    def __init__(self) -> None:
        self.epochs: dict[Source, Epoch] = {}
        self.solution: Solution | None = None
        self.interval_s = 0.0
        self._messages: deque[SolutionMessage] = deque(maxlen=SOLUTIONS)
        self._reason = Reason.OK

    def epoch(self, source: Source, epoch: Epoch) -> None:
        """Take an epoch of rover or base."""
        self.epochs[source] = epoch

    def solved(self, solution: Solution, message: SolutionMessage) -> str:
        """Take a solution; return what is wrong with it where that is news, else nothing."""
        if self.solution is not None:
            self.interval_s = solution.time - self.solution.time
        self.solution = solution
        self._messages.append(message)
        reason = solution.reason if solution.status in (Status.NONE, Status.SINGLE) or solution.reason is Reason.FILTER_RESET else Reason.OK
        news, self._reason = reason is not self._reason, reason
        return _words(solution) if news and reason is not Reason.OK else ""

    def newest(self, count: int) -> Sequence[SolutionMessage]:
        """Return the newest solutions, oldest first."""
        return list(self._messages)[-count:]

    def fresh(self) -> None:
        """The filter begins anew."""
        self._reason = Reason.OK


def _words(solution: Solution) -> str:
    text = solution.reason.name.lower().replace("_", " ")
    return f"{text} (age {solution.age_s:.1f} s)" if solution.reason is Reason.BASE_TOO_OLD else text
