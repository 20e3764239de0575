"""The integers of an epoch's baselines chosen together, where the places of the antennas are known: a solver knows only its own baseline.

Asked for where a baseline is not fixed, where fixed ones contradict the shape of the body, and where integers do not close around a
triangle. What is chosen takes part in the attitude as a baseline of its own kind.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import nan

import numpy as np

from rtkmesh.attitude.candidates import Candidates, known_baseline, pairs_of
from rtkmesh.attitude.closure import Closing, closing, fixed_among, triangles
from rtkmesh.attitude.integrity import Finding, Judged
from rtkmesh.attitude.joint import Edge
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.search import LEAST_AMBIGUITIES, Choice, Expectation, Verdict, choose
from rtkmesh.attitude.without_one import choose_without_one
from rtkmesh_schemas.candidates import CandidatesMessage
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_services.attitude.matching import MatchedEpoch
from rtkmesh_services.attitude.readings import FIX, Reading, SourceKind, SourceSpec
from rtkmesh_services.mapping.candidates import candidates_of

_SAME_M = 0.01  # a fix so near to what is chosen is the same, but for ambiguities that its solver left open


@dataclass(frozen=True, slots=True)
class Chosen:
    """What the geometry made of an epoch's readings. ``verdict`` of the choice, empty if none was needed, and how probably it is wrong.

    ``suspects``: antennas between which fixed integers do not close, which is not mended; ``notes``: what there is to say.
    """

    readings: dict[str, Reading]
    verdict: str = ""
    wrong_probability: float = nan
    suspects: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(slots=True)
class _Lines:
    """The baselines of an epoch that can be chosen: readings and tables in one order, and the integers of those that are fixed."""

    readings: list[Reading] = field(default_factory=list[Reading])
    tables: list[Candidates] = field(default_factory=list[Candidates])
    told: dict[int, Candidates] = field(default_factory=dict[int, Candidates])


class Geometry:
    """Chooses for one layout. ``judge`` tests edges against it; ``tilt_rad``: how far from level the body can be."""

    def __init__(self, layout: Layout, tilt_rad: float, judge: Callable[[list[Edge]], Judged]) -> None:
        self._layout, self._judge, self._expected = layout, judge, Expectation(tilt_rad)
        self._number = {name: number for number, name in enumerate(layout.names)}
        self.counts: Counter[str] = Counter()
        self.errors: Counter[str] = Counter()

    def _decoded(self, source: SourceSpec, message: CandidatesMessage | None) -> Candidates | None:
        """Return the candidates of a source's baseline, None if there are none; what are no candidates is counted in ``errors``."""
        if message is None or not message.norms:
            return None
        try:
            return candidates_of(message, self._number[source.start], self._number[source.end])
        except DecodeError:
            self.errors[source.id] += 1
            return None

    def wanted(self, readings: Mapping[str, Reading]) -> bool:
        """Return whether the candidates of these readings may change something."""
        lines = self._lines_of(readings)
        if any(reading.candidates_follow and not _is_fixed(reading) for reading in lines):
            return True
        fixed = [reading for reading in lines if _is_fixed(reading)]
        return bool(triangles(tuple(self._ends(reading) for reading in fixed))) or self._contradict(fixed)

    def chosen(self, epoch: MatchedEpoch) -> Chosen:
        """Return the readings of an epoch with what the geometry knows better."""
        lines = self._with_tables(epoch)
        around = closing(pairs_of(lines.tables), lines.told)
        self.counts["triangles_closed"] += around.closed
        self.counts["triangles_open"] += len(around.open)
        fixed = [reading for reading in lines.readings if _is_fixed(reading)]
        if len(fixed) == len(lines.readings) and not around.open and not self._contradict(fixed):
            all_fixed = all(map(_is_fixed, self._lines_of(epoch.readings)))
            return Chosen(epoch.readings, "" if all_fixed else Verdict.NO_CANDIDATES.value)
        choice = self._choice(lines.tables)
        self.counts[f"geometry_{choice.verdict.value.replace(' ', '_')}"] += 1
        if choice.accepted:
            return self._taken(epoch.readings, lines, choice)
        return self._without_one(epoch.readings, lines, choice) or self._refused(epoch.readings, lines, choice.verdict, around)

    def _choice(self, tables: Sequence[Candidates]) -> Choice:
        try:
            return choose(self._layout, tables, self._expected)
        except np.linalg.LinAlgError:  # covariances of a stranger
            return Choice(Verdict.NO_COMBINATION)

    def _without_one(self, readings: dict[str, Reading], lines: _Lines, refused: Choice) -> Chosen | None:
        """Return the readings with what is chosen without one antenna, its baselines put aside; None where there is no such choice."""
        try:
            rest = choose_without_one(self._layout, lines.tables, refused, self._expected)
        except np.linalg.LinAlgError:  # covariances of a stranger
            return None
        if rest is None:
            return None
        self.counts["geometry_without_one"] += 1
        kept = _Lines([lines.readings[i] for i in rest.kept], [lines.tables[i] for i in rest.kept])
        name = self._layout.names[rest.antenna]
        for reading in lines.readings:
            if name in (reading.source.start, reading.source.end):
                aside = replace(reading, edge=None, reason=f"integers of {reading.source.id} do not fit with the others")
                readings = readings | {reading.source.id: aside}
        return self._taken(readings, kept, rest.choice, rest.wrong_probability)

    def _lines_of(self, readings: Mapping[str, Reading]) -> list[Reading]:
        """Return the readings of baselines between antennas of the layout."""
        lines = [reading for reading in readings.values() if reading.source.kind is SourceKind.BASELINE]
        return [reading for reading in lines if {reading.source.start, reading.source.end} <= self._number.keys()]

    def _ends(self, reading: Reading) -> tuple[int, int]:
        return self._number[reading.source.start], self._number[reading.source.end]

    def _contradict(self, fixed: Sequence[Reading]) -> bool:
        edges = [reading.edge for reading in fixed if reading.edge is not None]
        return bool(edges) and self._judge(edges).finding in (Finding.EXCLUDED, Finding.NOT_IDENTIFIABLE)

    def _with_tables(self, epoch: MatchedEpoch) -> _Lines:
        lines = _Lines()
        for reading in self._lines_of(epoch.readings):
            table, told = self._table(reading, self._decoded(reading.source, epoch.candidates.get(reading.source.id)))
            if told is not None:
                lines.told[len(lines.tables)] = told
            if table is not None:
                lines.readings.append(reading)
                lines.tables.append(table)
        return lines

    def _table(self, reading: Reading, table: Candidates | None) -> tuple[Candidates | None, Candidates | None]:
        """Return what there is to choose from for a baseline, and the integers of one that is fixed. A fix of no candidate is known."""
        if not _is_fixed(reading) or reading.edge is None:
            return table if table is not None and table.count >= LEAST_AMBIGUITIES else None, None
        told = None if table is None else fixed_among(table, reading.edge.vector_ned_m)
        if table is None or told is None or table.count < LEAST_AMBIGUITIES:
            return known_baseline(*self._ends(reading), reading.edge.vector_ned_m, reading.edge.cov_m2), told
        return table, told

    def _taken(self, readings: dict[str, Reading], lines: _Lines, choice: Choice, wrong_probability: float | None = None) -> Chosen:
        """Return the readings with the chosen baselines instead of those that are not fixed, or fixed elsewhere.

        ``wrong_probability`` of the choice, where it is not its own.
        """
        found, notes, wrong = dict(readings), list[str](), choice.wrong_probability if wrong_probability is None else wrong_probability
        for reading, table, number in zip(lines.readings, lines.tables, choice.chosen, strict=True):
            vector = table.baselines_ned_m[number]
            if table.known or _is_at(reading, vector):
                continue
            if _is_fixed(reading):
                self.counts["fixes_overruled"] += 1
                notes.append(f"{reading.source.id} was fixed elsewhere")
            edge = Edge(reading.source.start, reading.source.end, vector, table.cov_ned_m2, wrong=wrong)
            found[reading.source.id] = replace(reading, edge=edge, reason="", status=FIX, status_name="FIX", chosen=True)
        return Chosen(found, choice.verdict.value, wrong, notes=tuple(notes))

    def _refused(self, readings: dict[str, Reading], lines: _Lines, verdict: Verdict, around: Closing) -> Chosen:
        """Return the readings as they are, but for a fix that does not close with the others."""
        if around.wrong is not None:
            wrong = lines.readings[around.wrong]
            aside = replace(wrong, edge=None, reason=f"integers of {wrong.source.id} do not close with the others")
            return Chosen(readings | {wrong.source.id: aside}, verdict.value)
        open_ = [lines.readings[side].source for triangle in around.open for side in triangle]
        suspects = tuple(name for name in self._layout.names if any(name in (source.start, source.end) for source in open_))
        notes = (f"integers of {', '.join(dict.fromkeys(source.id for source in open_))} do not close",) if open_ else ()
        return Chosen(readings, verdict.value, suspects=suspects, notes=notes)


def _is_fixed(reading: Reading) -> bool:
    return reading.edge is not None and reading.status == FIX


def _is_at(reading: Reading, vector_ned_m: np.ndarray) -> bool:
    """Return whether a fixed baseline is the one that was chosen."""
    return _is_fixed(reading) and reading.edge is not None and float(np.linalg.norm(reading.edge.vector_ned_m - vector_ned_m)) < _SAME_M
