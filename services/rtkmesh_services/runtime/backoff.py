"""How long to wait before a source is opened again: quick where that costs nobody anything, slower and slower at casters."""

from dataclasses import dataclass
from random import Random
from typing import Final

from rtkmesh_services.errors import RefusedError, SourceError


@dataclass(frozen=True, slots=True)
class Backoff:
    """Pauses from ``first_s``, doubled up to ``last_s``. Each is longer by a random share up to ``jitter``.

    A connection that brought data for ``good_s`` counts as a success: the next pause is the first one again; after one that brought
    data for less it is ``brief_last_s`` at most. After a lasting refusal (wrong password, no such mount point) pauses go from
    ``refused_first_s`` to ``refused_last_s``.
    """

    first_s: float
    last_s: float
    jitter: float = 0.0
    good_s: float = 0.0
    brief_last_s: float = 10.0
    refused_first_s: float = 60.0
    refused_last_s: float = 900.0


LOCAL: Final = Backoff(0.1, 0.5)  # a restarted server shall be back within the second
CASTER: Final = Backoff(1.0, 60.0, jitter=0.5, good_s=30.0)  # public casters ban clients that come back faster


class Pauses:
    """The pauses of one source."""

    def __init__(self, backoff: Backoff, random: Random | None = None) -> None:
        self._backoff, self._random = backoff, random or Random()  # noqa: S311  no secret
        self._next_s, self._refused_s = backoff.first_s, backoff.refused_first_s

    def after(self, heard_s: float, error: SourceError | OSError | None = None) -> float:
        """Return the pause after a connection that brought data for ``heard_s`` and ended with an error or without one."""
        if heard_s > 0.0 and heard_s >= self._backoff.good_s:
            self._next_s, self._refused_s = self._backoff.first_s, self._backoff.refused_first_s
        if isinstance(error, RefusedError) and error.lasting:
            pause_s, self._refused_s = self._refused_s, min(self._backoff.refused_last_s, 2.0 * self._refused_s)
        else:
            pause_s = min(self._next_s, self._backoff.brief_last_s) if heard_s > 0.0 else self._next_s
            self._next_s = min(self._backoff.last_s, 2.0 * self._next_s)
        wanted_s = error.wait_s if isinstance(error, RefusedError) else 0.0
        return max(pause_s, wanted_s) * (1.0 + self._backoff.jitter * self._random.random())
