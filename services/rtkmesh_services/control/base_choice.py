"""Which preset of its list a solver uses: the chosen one, another one while that is silent or bad. No thread, no clock."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from rtkmesh_schemas.config_presets import BasesTable

_STARTING_S: Final = 30.0  # a process that has said nothing yet has so much more time
_BETTER: Final = 0.2  # a score that makes a base good is so much above the one that makes it bad


@dataclass(slots=True)
class Choice:
    """The base of one solver. ``names``: its list in the file; ``order``: the chosen one, then the list."""

    limits: BasesTable
    names: tuple[str, ...] = ()
    order: tuple[str, ...] = ()
    active: str | None = None
    trying: bool = False
    _bad_since_s: dict[str, float] = field(default_factory=dict[str, float])
    _good_since_s: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def wanted(self) -> tuple[str, ...]:
        """The presets that have to run: all of the list while the chosen one is not what it should be."""
        return self.order if self.trying else self.order[:1]

    def prefer(self, name: str | None, now_s: float, *, starting: bool = False) -> None:
        """Take another one: it has the time-out of the file to deliver, from its first status on if its process is ``starting``."""
        self.order = () if name is None else tuple(dict.fromkeys((name, *self.names)))
        self.active, self.trying = name, False
        self._bad_since_s.clear()
        self._good_since_s.clear()
        if name is not None:
            self._give_time(name, now_s + (_STARTING_S if starting else 0.0))

    def started(self, name: str, now_s: float) -> None:
        """The process of a preset has said its first status."""
        if name == self.active and name in self._bad_since_s:
            self._give_time(name, now_s)

    def update(self, scores: Mapping[str, float], now_s: float) -> str:
        """Take the scores of this moment; return why another one is active now, or nothing."""
        for name in self.order:
            self._note(name, scores.get(name, 0.0), now_s)
        if self.active is None:
            return ""
        place = self.order.index(self.active)
        self.trying = place > 0 or self._is_bad(self.active, now_s)
        for better in self.order[:place]:
            if now_s - self._good_since_s.get(better, now_s) >= self.limits.return_after_s:
                return self._take(better, f"has been good for {self.limits.return_after_s:g} s again")
        if not self._is_bad(self.active, now_s):
            return ""
        other = next((name for name in self.order if name != self.active and name in self._good_since_s), None)
        return (
            "" if other is None else self._take(other, f"in place of {self.active}, silent or bad for {self.limits.failover_after_s:g} s")
        )

    def _give_time(self, name: str, now_s: float) -> None:
        self._bad_since_s[name] = now_s + max(0.0, self.limits.timeout_s - self.limits.failover_after_s)

    def _take(self, name: str, why: str) -> str:
        self.active = name
        return why

    def _is_bad(self, name: str, now_s: float) -> bool:
        return now_s - self._bad_since_s.get(name, now_s) >= self.limits.failover_after_s

    def _note(self, name: str, score: float, now_s: float) -> None:
        if score < self.limits.bad_score:
            self._bad_since_s.setdefault(name, now_s)
        else:
            self._bad_since_s.pop(name, None)
        if score >= min(1.0, self.limits.bad_score + _BETTER):
            self._good_since_s.setdefault(name, now_s)
        else:
            self._good_since_s.pop(name, None)
