"""Protection levels of published attitudes, and whether they are inside the alert limits of the site."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import degrees, inf, isfinite, nan, radians

import msgspec
import numpy as np

from rtkmesh.attitude.joint import joint
from rtkmesh.attitude.protection import Guarding, Levels, Told, baseline_levels, fault_priors, levels, line_levels
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles
from rtkmesh.gnss.integrity import Integrity
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.config import SolverTable
from rtkmesh_schemas.config_attitude import AttitudeTable
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.attitude.body import BodyAttitude
from rtkmesh_services.attitude.readings import SourceKind, wrong_probability
from rtkmesh_services.runtime.attitude_checks import risk_of

_ANGLES = ("heading", "pitch", "roll")


class Guard:
    """The levels of one attitude process; ``layout``: of its antennas, None where it has one baseline without places."""

    def __init__(self, table: AttitudeTable, layout: Layout | None, solvers: Mapping[str, SolverTable]) -> None:
        options = table.integrity
        self._watched = frozenset(name for name, solver in solvers.items() if risk_of(solver) <= options.risk)
        self._guarding = Guarding(options.risk, options.antenna_fault, radians(table.unseen_tilt_deg))
        self._layout = layout
        tilt_deg = options.alert_tilt_deg
        self._limits_deg = tuple(inf if limit is None else limit for limit in (options.alert_heading_deg, tilt_deg, tilt_deg))

    def of_body(self, found: BodyAttitude, message: AttitudeMessage) -> AttitudeMessage:
        """Return the message of an epoch with its levels and what they mean for its integrity."""
        bounds = self._by_satellites(self._levels(found), found)
        return self._judged(message, bounds, list(dict.fromkeys(name.split(": ")[0] for name in bounds.open)))

    def of_line(self, message: AttitudeMessage, solution: SolutionMessage) -> AttitudeMessage:
        """Return the message of one baseline, a solution that its length alone tests, with its levels."""
        sigmas = np.sqrt(np.diag(np.array(message.covariance_rad2).reshape(3, 3)))
        prior = max(self._guarding.antenna_fault, wrong_probability(solution))
        levels_rad = line_levels(sigmas, prior, self._guarding)
        left_open = message.antennas_used if np.isinf(levels_rad).any() else []
        if left_open and message.integrity == Integrity.OK.value and (told := self._told(solution)) is not None:
            angles = (angle if isfinite(angle) else 0.0 for angle in (message.heading_rad, message.pitch_rad, message.roll_rad))
            line = told.vector_ned_m / np.linalg.norm(told.vector_ned_m)
            by_satellites = baseline_levels(rotation_of_angles(*angles), line, told, self._guarding)
            levels_rad = np.where(np.isinf(levels_rad), by_satellites, levels_rad)
        return self._judged(message, Levels(levels_rad), left_open)

    def _levels(self, found: BodyAttitude) -> Levels:
        """Return the levels, without the second vectors of receivers that tell a whole attitude: these would seem to watch the first."""
        edges = [reading.edge for reading in found.readings if reading.edge is not None]
        if found.judged.fit is None or self._layout is None or not edges:
            return Levels(np.full(3, nan))
        priors = fault_priors(self._layout, edges, self._guarding.antenna_fault)
        try:
            measured = found.measured if found.measured is not None and not _across(found) else joint(self._layout, edges)
            bounds = levels(self._layout, measured, found.judged, self._guarding, priors)
        except np.linalg.LinAlgError:  # covariances of a stranger
            return Levels(np.full(3, inf))
        return self._unbounded(bounds, found) if self._may_be_wrong_together(found) else bounds

    def _by_satellites(self, bounds: Levels, found: BodyAttitude) -> Levels:
        """Return the levels, where two antennas leave them open, by those of their baseline."""
        fit = found.judged.fit
        lines = [r for r in found.readings if r.kind is SourceKind.BASELINE and {r.source.start, r.source.end} <= {*found.used}]
        if fit is None or fit.unseen_ned is None or len(found.used) != 2 or not lines or found.judged.integrity is Integrity.FAILED:
            return bounds
        told = None if lines[0].solution is None else self._told(lines[0].solution)
        if told is None:
            return bounds
        by_satellites = baseline_levels(fit.ned_from_body, fit.unseen_ned, told, self._guarding)
        return replace(bounds, rad=np.where(np.isinf(bounds.rad), by_satellites, bounds.rad))

    def _told(self, solution: SolutionMessage) -> Told | None:
        """Return what a solver says of its baseline, None where it takes a larger risk than the attitude."""
        if solution.source not in self._watched:
            return None
        return Told(NED_FROM_ENU @ np.array(solution.baseline_enu_m), solution.protection_horizontal_m, solution.protection_vertical_m)

    def _may_be_wrong_together(self, found: BodyAttitude) -> bool:
        """Return whether baselines that the geometry chose together are wrong together with more than a hypothesis' share of the risk."""
        together = sum(reading.chosen for reading in found.readings) > 1
        return together and found.chosen is not None and found.chosen.wrong_probability > 0.25 * self._guarding.risk

    def _unbounded(self, bounds: Levels, found: BodyAttitude) -> Levels:
        """Return levels that bound nothing: no antenna is left that a wrong combination of integers has not touched."""
        ends = {end for reading in found.readings if reading.chosen for end in (reading.source.start, reading.source.end)}
        return Levels(np.where(np.isnan(bounds.rad), nan, inf), tuple(name for name in found.used if name in ends))

    def _judged(self, message: AttitudeMessage, bounds: Levels, left_open: list[str]) -> AttitudeMessage:
        heading, pitch, roll = bounds.rad.tolist()
        told = msgspec.structs.replace(message, protection_rad=(heading, pitch, roll), protection_open=left_open)
        beyond = "; ".join(self._beyond((heading, pitch, roll)))
        if message.integrity != Integrity.OK.value or not beyond:
            return told
        reason = "; ".join(part for part in (message.reason, beyond) if part)
        return msgspec.structs.replace(told, integrity=Integrity.UNAVAILABLE.value, reason=reason)

    def _beyond(self, levels_rad: tuple[float, ...]) -> Iterator[str]:
        """Yield what is to be said of levels beyond their limits."""
        for name, level_rad, limit_deg in zip(_ANGLES, levels_rad, self._limits_deg, strict=True):
            if degrees(level_rad) > limit_deg:
                how = f"may be off by {degrees(level_rad):.1f} deg" if isfinite(level_rad) else "is not bounded"
                yield f"{name} {how} (limit {limit_deg:g} deg)"


def _across(found: BodyAttitude) -> bool:
    return any(reading.across is not None for reading in found.readings)
