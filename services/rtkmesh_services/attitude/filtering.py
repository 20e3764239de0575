"""The filtered attitude: what each epoch gives and a gyro in between, as one attitude that goes on while epochs are missing."""

from collections import Counter
from collections.abc import Iterable
from math import radians
from typing import Any

import msgspec
import numpy as np

from rtkmesh.attitude.course import COURSE, CourseOptions
from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import Estimate, FilterOptions, Kind, Trust, Update
from rtkmesh.attitude.heading_filter import HeadingFilter, filter_of
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.attitude import NAN3, NAN4, NAN9, AttitudeMessage
from rtkmesh_schemas.config_attitude import AttitudeFilterTable, AttitudeTable, ImuTable
from rtkmesh_services.attitude.body import BodyAttitude
from rtkmesh_services.attitude.imu import imu_of
from rtkmesh_services.attitude.messages import angles_fields, rotation_fields
from rtkmesh_services.attitude.motion import Courses, Velocity, velocity_of
from rtkmesh_services.attitude.points import filtered_points
from rtkmesh_services.attitude.readings import FIX, Reading, SourceKind
from rtkmesh_services.attitude.tilts import Tilts

_SEEN_SHARE = 0.5  # of the sigma of a tilt that nothing measures


class Filtering:
    """The filter of one attitude process and its figures."""

    def __init__(self, table: AttitudeTable, options: AttitudeFilterTable, unseen_sigma_rad: float, courses: Courses | None = None) -> None:
        self._filter = filter_of(options_of(options, table, unseen_sigma_rad))
        self._imu = ImuTable(key="none") if table.imu is None else table.imu
        self._tilts = Tilts(self._imu)
        self._course_of = "" if table.course is None else table.course.position
        self._moving = self._course_of or next(iter(table.positions), "")
        self._courses = courses
        self._points = {name: point.position_m for name, point in table.points.items()}
        self._antennas = {name: np.array(antenna.position_m) for name, antenna in table.antennas.items()}
        self._unseen_rad = unseen_sigma_rad
        self.counts: Counter[str] = Counter()

    @property
    def resets(self) -> int:
        """How often the filter began anew."""
        return self._filter.resets

    def epoch(self, found: BodyAttitude) -> Update | None:
        """Take the attitude of an epoch; None when it has none."""
        fit = found.judged.fit
        if fit is None:
            return None
        fixed = all(reading.status == FIX for reading in found.readings)
        integrity = Integrity.FAILED if found.judged.integrity is Integrity.FAILED else Integrity.OK
        return self._counted("epochs", self._filter.rotation(found.time, fit, Trust(fixed=fixed, integrity=integrity)))

    def imu(self, payload: bytes, encoding: str) -> GpsTime:
        """Take a sample of an IMU and return its time; DecodeError for what is none."""
        sample = imu_of(payload, encoding)
        if sample.rate_radps is not None:
            self._counted("gyro", self._filter.gyro(sample.time, np.array(sample.rate_radps), self._imu.sigma_radps))
        if sample.force_mps2 is not None:
            self._tilts.take(sample.time, np.array(sample.force_mps2))
            self.level()
        if sample.yaw is not None:
            self._yaw(sample.time, *sample.yaw)
        return sample.time

    def level(self) -> None:
        """Take the tilts whose accelerations are known by now."""
        if isinstance(self._filter, AttitudeFilter):
            for update in self._tilts.applied(self._filter):
                self._counted("tilt", update)

    def moved(self, readings: Iterable[Reading]) -> None:
        """Take the velocities of positions: accelerations for the plumb line, and the course."""
        for reading in readings:
            velocity = velocity_of(reading) if reading.source.kind is SourceKind.POSITION else None
            if velocity is None:
                continue
            if reading.source.id == self._moving:
                self._tilts.motion.take(velocity)
            if self._courses is not None and reading.source.id == self._course_of:
                self._steered(self._courses, velocity)
        self.level()

    def _steered(self, courses: Courses, velocity: Velocity) -> None:
        told = courses.heading(velocity, self._filter.predicted(velocity.time))
        if told is not None:
            self._counted("course", self._filter.heading(velocity.time, *told, trust=COURSE))

    def _yaw(self, end: GpsTime, grown_rad: float, interval_s: float) -> None:
        if isinstance(self._filter, HeadingFilter):
            sigma = self._imu.yaw_increment_sigma_rad
            self._counted("yaw", self._filter.yaw_increment(end + -interval_s, end, grown_rad, sigma))
        else:
            self.counts["yaw_not_used"] += 1

    def message(self, time: GpsTime, epoch: AttitudeMessage, found: BodyAttitude | None, **identity: Any) -> AttitudeMessage:
        """Return the filtered attitude at a time, with what is to be said of the newest epoch before it; points are of ``found`` alone."""
        estimate = self._filter.predicted(time)
        points = {} if found is None else filtered_points(self._points, found, epoch.points, estimate, self._antennas)
        fields = _known(estimate, self._unseen_rad) if estimate.ned_from_body is not None else _unknown(estimate)
        told: dict[str, Any] = {
            "week": time.week,
            "tow_s": time.tow_s,
            "predicted_s": estimate.age_s,
            "resets": self.resets,
            "points": points,
        }
        told |= {"protection_rad": NAN3, "protection_open": []}
        return msgspec.structs.replace(epoch, **(told | fields | identity))

    def _counted(self, what: str, update: Update) -> Update:
        self.counts[f"{what}_{update.outcome.value}"] += 1
        return update


def options_of(table: AttitudeFilterTable, attitude: AttitudeTable, unseen_sigma_rad: float) -> FilterOptions:
    """Return the engine's options of a table."""
    return FilterOptions(
        kind=Kind(table.kind),
        rate_walk_radps_rts=table.rate_walk_radps_rts,
        correlation_s=table.correlation_s,
        false_alarm=table.false_alarm,
        max_coast_s=table.max_coast_s,
        level_sigma_rad=unseen_sigma_rad,
        accept_float=attitude.accept_float,
    )


def _known(estimate: Estimate, unseen_sigma_rad: float) -> dict[str, Any]:
    assert estimate.ned_from_body is not None, "it is usable"
    cov = estimate.angles_cov_rad2
    unseen = np.sqrt(np.diag(cov)) > _SEEN_SHARE * unseen_sigma_rad
    cov[unseen, :] = cov[:, unseen] = np.nan
    return {
        **angles_fields(estimate.angles_rad, cov),
        **rotation_fields(estimate.ned_from_body, estimate.cov_rad2),
        "integrity": Integrity.OK.value,
        "rate_radps": tuple(estimate.rate_body_radps.tolist()),
        "rate_cov_rad2ps2": tuple(estimate.rate_cov_radps2.ravel().tolist()),
    }


def _unknown(estimate: Estimate) -> dict[str, Any]:
    return {
        **angles_fields(estimate.angles_rad, estimate.angles_cov_rad2),
        "quaternion_ned_from_body": NAN4,
        "quaternion_enu_from_flu": NAN4,
        "rotation_cov_ned_rad2": NAN9,
        "integrity": Integrity.UNAVAILABLE.value,
        "reason": f"filter: {estimate.why.value}",
    }


def courses_of(table: AttitudeTable, antenna: str) -> Courses | None:
    """Return the courses of a table; ``antenna``: of the position whose velocity it is."""
    if table.course is None:
        return None
    options = CourseOptions(table.course.min_speed_mps, radians(table.course.sideslip_deg), radians(table.course.max_sigma_deg))
    return Courses(options, np.array(table.antennas[antenna].position_m))
