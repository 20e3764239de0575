"""Where a receiver's corrections come from: the first of some bases that speaks, through the gate, into the queue of its writer."""

from collections.abc import Sequence
from math import inf
from typing import Any, Final

from rtkmesh_schemas.config import CorrectionsTable
from rtkmesh_schemas.keys import RAW
from rtkmesh_schemas.status import InputStatus, Level
from rtkmesh_services.ingest.correction_gate import CorrectionGate
from rtkmesh_services.ingest.corrections import CorrectionQueue
from rtkmesh_services.ingest.feedback import Feedback
from rtkmesh_services.ntrip.frames import message_number
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context

LANE: Final = "corrections"
STEADY_S: Final = 5.0  # a better placed base is taken again when it has spoken for so long
PAUSE_S: Final = 2.5  # longer silence breaks steadiness: corrections come at least every second or two


class BaseChoice:
    """Which of several bases is used: the first one that speaks. ``active`` is its place in the list, None before any spoke."""

    def __init__(self, count: int, fallback_after_s: float) -> None:
        self._heard_s, self._since_s = [-inf] * count, [inf] * count
        self._after_s = fallback_after_s
        self._begun_s: float | None = None
        self.active: int | None = None

    def heard(self, base: int, now_s: float) -> bool:
        """Take note that a base speaks; return whether another one is used from now on."""
        if self._begun_s is None:
            self._begun_s = now_s
        if now_s - self._heard_s[base] > PAUSE_S:
            self._since_s[base] = now_s
        self._heard_s[base] = now_s
        if base == self.active or not self._is_better(base, now_s):
            return False
        self.active = base
        return True

    def _is_better(self, base: int, now_s: float) -> bool:
        if self.active is None:  # those before it have their time to speak
            return base == 0 or now_s - (self._begun_s or 0.0) >= self._after_s
        silent = now_s - self._heard_s[self.active] >= self._after_s
        return silent or (base < self.active and now_s - self._since_s[base] >= STEADY_S)

    def age_s(self, now_s: float) -> float:
        """Return for how long the base in use has been silent; inf before any was used."""
        return inf if self.active is None else now_s - self._heard_s[self.active]


class CorrectionFeed:
    """Feeds the corrections of one receiver."""

    def __init__(self, context: Context, table: CorrectionsTable) -> None:
        self._context, self._table = context, table
        self.queue = CorrectionQueue(table.link_bytes_per_s)
        self.feedback = Feedback()
        self._bases: Sequence[str] = table.bases
        self._keys = {RAW.key(base, protocol="rtcm3"): index for index, base in enumerate(self._bases)}
        self._choice = BaseChoice(len(self._bases), table.fallback_after_s)
        self._gate = CorrectionGate(table)
        self._left_out = self._bytes = self._frames = 0
        self._unused = ""

    def open(self) -> None:
        """Subscribe to the bases."""
        for key in self._keys:
            self._context.subscribe(key, lane=LANE)

    def takes(self, sample: Sample, now_s: float) -> bool:
        """Take a frame of a base; return whether it is one."""
        base = self._keys.get(sample.key)
        if base is None:
            return False
        if self._choice.heard(base, now_s):
            self._switch(base)
        if base == self._choice.active:
            self._frames, self._bytes = self._frames + 1, self._bytes + len(sample.payload)
            passed = self._gate.take(sample.payload, now_s)
            self._left_out += not self._gate.passes(message_number(sample.payload))
            for correction in passed:
                self.queue.put(correction, now_s)
        return True

    def tick(self, now_s: float) -> None:
        """Send what has waited for the rest of its epoch; tell when the receiver uses nothing of it."""
        for correction in self._gate.flush(now_s):
            self.queue.put(correction, now_s)
        complaint = self.feedback.complaint(now_s)
        if complaint and not self._unused:
            self._context.event(Level.WARNING, "corrections_unused", complaint, logged=False)
        self._unused = complaint

    def complaint(self, now_s: float) -> str:
        """Return what is wrong with the corrections, or nothing."""
        age_s = self._choice.age_s(now_s)
        if age_s > self._table.fallback_after_s:
            return f"no corrections from {', '.join(self._bases)}{f' for {age_s:.0f} s' if age_s < inf else ''}"
        return self._unused

    def status(self, now_s: float) -> InputStatus:
        """Return the row of an ingest's status."""
        counts, active = self.queue.told(), self._choice.active
        age_s = self._choice.age_s(now_s)
        rate = f", {self.queue.rate:.0f} bytes/s" if self.queue.rate else ""
        state = "waiting for data" if active is None else "silent" if age_s > self._table.fallback_after_s else "connected"
        return InputStatus(
            name="corrections",
            state=state,
            detail=f"{self._bases[active or 0]} to the receiver{rate}",
            messages=self._frames,
            bytes=self._bytes,
            age_s=None if age_s == inf else age_s,
            dropped=counts.dropped.total(),
            counters={f"rtcm3/{number}": count for number, count in sorted(counts.written.items())},
        )

    def data(self, now_s: float) -> dict[str, Any]:
        """Return what became of each kind of message, for a status."""
        counts, active = self.queue.told(), self._choice.active
        numbers = sorted(counts.queued)
        kinds = ("queued", "written", "dropped", "replaced")
        return {
            "base": "" if active is None else self._bases[active],
            "messages": {str(number): {kind: getattr(counts, kind)[number] for kind in kinds} for number in numbers},
            "left_out": self._left_out,
            "dropped_epochs": counts.dropped_epochs,
            "written_bytes": counts.written_bytes,
            "link_bytes_per_s": self.queue.rate,
            "waited_s": counts.newest_wait_s,
            "feedback": self.feedback.data(now_s),
        }

    def _switch(self, base: int) -> None:
        if self._frames:
            self.queue.restart()
            self._gate = CorrectionGate(self._table)
        level = Level.WARNING if base else Level.INFO
        self._context.event(
            level, "corrections_from", f"corrections for the receiver come from {self._bases[base]}", base=self._bases[base]
        )
