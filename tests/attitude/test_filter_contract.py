"""What a consumer of the attitude filter may rely on before it knows anything of how it works."""

from math import isnan, radians

import numpy as np

from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import FilterOptions, Outcome, Why
from rtkmesh.gnss.time import GpsTime

T0 = GpsTime(2400, 100.0)


def test_before_any_measurement_there_is_no_attitude() -> None:
    """Fault 1 of seed_systems.md 2.2: no solution is not north."""
    estimate = AttitudeFilter(FilterOptions()).predicted(T0)
    assert (estimate.usable, estimate.why, estimate.ned_from_body) == (False, Why.NOT_ALIGNED, None)
    assert all(isnan(angle) for angle in estimate.angles_rad)
    assert np.isnan(estimate.angles_cov_rad2).all()


def test_the_first_heading_starts_it() -> None:
    attitude = AttitudeFilter(FilterOptions())
    assert attitude.heading(T0, radians(350.0), radians(0.2)).outcome is Outcome.STARTED
    heading, pitch, roll = attitude.predicted(T0 + 0.1).angles_rad
    assert np.allclose([heading, pitch, roll], [radians(350.0), 0.0, 0.0], atol=1e-12)
