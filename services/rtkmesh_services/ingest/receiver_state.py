"""What a receiver tells of itself, as the ingest's status shows it; what calls for attention becomes an event."""

from collections import Counter
from collections.abc import Callable
from math import degrees, isfinite
from typing import Any

from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.receiver import (
    AntennaState,
    CommandAnswer,
    CorrectionUse,
    EventMark,
    Jamming,
    PortsHealth,
    PortUse,
    ReceiverHeading,
    ReceiverReport,
    ReceiverVersion,
    RfBlock,
    RfHealth,
    SatellitesInView,
    SurveyIn,
)
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.status import Level

Tell = Callable[..., None]  # Context.event

_FAULTS = {
    AntennaState.SHORT: "antenna: short circuit",
    AntennaState.OPEN: "antenna: no antenna",
    Jamming.WARNING: "interference, position is still possible",
    Jamming.CRITICAL: "interference, no position",
}


class ReceiverState:
    """The newest of each kind of report. Used by the work loop alone."""

    def __init__(self) -> None:
        self._newest: dict[str, tuple[int, dict[str, Any]]] = {}
        self._corrections: Counter[str] = Counter()
        self._answers: Counter[str] = Counter()
        self._marks = 0
        self._faults: set[str] = set()

    def take(self, report: ReceiverReport, mono_ns: int, tell: Tell) -> None:
        """Remember a report; ``tell`` publishes event marks, faults and refusals."""
        if isinstance(report, EventMark):
            self._mark(report, tell)
        elif isinstance(report, CommandAnswer):
            self._answer(report, tell)
        elif isinstance(report, CorrectionUse):
            self._correction(report, mono_ns)
        elif isinstance(report, RfHealth):
            self._newest["radio"] = (mono_ns, {"source": report.source, "blocks": [_block(block) for block in report.blocks]})
            self._tell_faults(report, tell)
        else:
            name, values = _summary(report)
            self._newest[name] = (mono_ns, values)

    def take_setup(self, station: ReferenceStation, mono_ns: int) -> None:
        """Remember what a Septentrio says that it is: name and firmware, which come with its antenna (ReceiverSetup)."""
        if station.source == "sbf" and station.receiver:
            model, _, software = station.receiver.rpartition(" ")
            self._newest["receiver"] = (mono_ns, {"model": model, "software": software, "hardware": ""})

    def data(self, now_ns: int) -> dict[str, Any]:
        """Return what the status shows: of each report its age, of what is counted the counts."""
        found: dict[str, Any] = {
            name: {**values, "age_s": round((now_ns - mono_ns) * 1e-9, 3)} for name, (mono_ns, values) in self._newest.items()
        }
        if self._marks:
            found["event_marks"] = self._marks
        if self._answers:
            found["commands"] = dict(self._answers)
        return found

    def _mark(self, mark: EventMark, tell: Tell) -> None:
        self._marks += 1
        edges = {"rising": _instant(mark.rising), "falling": _instant(mark.falling)}
        text = ", ".join(f"{name} {time[0]} {time[1]:.9f}" for name, time in edges.items() if time is not None)
        told = f"event {mark.count} at input {mark.channel}: {text or 'no time'}"
        tell(Level.INFO, "event_mark", told, logged=False, channel=mark.channel, count=mark.count, accuracy_s=mark.accuracy_s, **edges)

    def _answer(self, answer: CommandAnswer, tell: Tell) -> None:
        self._answers["accepted" if answer.accepted else "refused"] += 1
        if not answer.accepted:
            tell(Level.WARNING, "command_refused", f"the receiver refused {answer.command!r}: {answer.text}", command=answer.command)

    def _correction(self, use: CorrectionUse, mono_ns: int) -> None:
        counts = self._corrections
        counts["messages"] += 1
        counts["failed_crc"] += use.failed_crc
        counts["used"] += use.used is True
        counts["not_used"] += use.used is False
        self._newest["corrections_used"] = (mono_ns, {**counts, "message": use.message, "station_id": use.station_id})

    def _tell_faults(self, health: RfHealth, tell: Tell) -> None:
        """Tell each fault when it comes."""
        faults = {_FAULTS[state] for block in health.blocks for state in (block.antenna, block.jamming) if state in _FAULTS}
        for text in sorted(faults - self._faults):
            tell(Level.WARNING, "receiver_fault", text)
        self._faults = faults


def _block(block: RfBlock) -> dict[str, Any]:
    return {
        "block": block.block,
        "antenna": block.antenna.value,
        "powered": block.powered,
        "jamming": block.jamming.value,
        "jamming_indicator": round(block.jamming_indicator, 3),
        "gain": round(block.gain, 3),
        "noise": block.noise,
    }


def _summary(report: ReceiverHeading | SurveyIn | SatellitesInView | PortsHealth | ReceiverVersion) -> tuple[str, dict[str, Any]]:
    """Return the name in the status and the values of a report of which the newest counts."""
    if isinstance(report, ReceiverHeading):
        return "heading", _heading(report)
    if isinstance(report, SurveyIn):
        return "survey_in", {
            "active": report.active,
            "valid": report.valid,
            "duration_s": report.duration_s,
            "observations": report.observations,
            "accuracy_m": _known(report.accuracy_m),
            "position_ecef_m": report.position_ecef_m,
        }
    if isinstance(report, SatellitesInView):
        return "satellites_in_view", {
            "known": len(report.satellites),
            "received": sum(isfinite(row.cn0_dbhz) for row in report.satellites),
            "used": sum(row.used for row in report.satellites),
        }
    if isinstance(report, PortsHealth):
        return "ports", {
            "memory_full": report.memory_full,
            "buffer_full": report.buffer_full,
            **{port.port: _port(port) for port in report.ports},
        }
    return "receiver", {"model": report.model, "software": report.software, "hardware": report.hardware}


def _port(port: PortUse) -> dict[str, Any]:
    return {"overruns": port.overruns, "sent_load": port.sent_load, "received_load": port.received_load}


def _heading(heading: ReceiverHeading) -> dict[str, Any]:
    return {
        "source": heading.source,
        "valid": heading.valid,
        "solution": None if heading.solution is None else heading.solution.name,
        "heading_deg": _angle(heading.heading_rad),
        "heading_sigma_deg": _angle(heading.heading_sigma_rad),
        "pitch_deg": _angle(heading.pitch_rad),
        "length_m": _known(heading.length_m),
        "baseline_ned_m": heading.baseline_ned_m,
        "extrapolated": heading.extrapolated,
        "satellites": heading.satellites,
    }


def _angle(value_rad: float) -> float | None:
    return _known(degrees(value_rad))


def _known(value: float) -> float | None:
    return round(value, 4) if isfinite(value) else None


def _instant(time: GpsTime | None) -> tuple[int, float] | None:
    return None if time is None else (time.week, time.tow_s)
