"""Candidates of baselines until their epoch is complete: they may come before its readings or after them."""

from collections import deque
from collections.abc import Sequence

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.candidates import CandidatesMessage
from rtkmesh_services.attitude.readings import Reading

KEPT = 16  # of each source: more epochs are never pending for long
_SAME_S = 1e-4  # a solution and its candidates have one time


class Shelf:
    """The newest candidates of each source by their time."""

    def __init__(self, sources: Sequence[str]) -> None:
        self._rows: dict[str, deque[tuple[GpsTime, CandidatesMessage]]] = {name: deque(maxlen=KEPT) for name in sources}

    def put(self, source: str, time: GpsTime, found: CandidatesMessage) -> None:
        """Keep candidates."""
        self._rows[source].append((time, found))

    def awaits(self, source: str, reading: Reading) -> bool:
        """Return whether the candidates of a reading may still come: a source tells them in order."""
        return reading.candidates_follow and all(time - reading.time < -_SAME_S for time, _ in self._rows[source])

    def take(self, source: str, time: GpsTime) -> CandidatesMessage | None:
        """Return the candidates of an instant and forget those before it."""
        rows = self._rows[source]
        while rows and rows[0][0] - time < -_SAME_S:
            rows.popleft()
        return rows.popleft()[1] if rows and rows[0][0] - time <= _SAME_S else None
