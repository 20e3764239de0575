"""Solutions as messages: lines of positions need a part of one, and are the same from it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh_services.mapping.solution import position_message, solution_message
from rtkmesh_services.texts import TextOptions, TextWriter

FORMS = ("llh", "xyz", "enu", "vel_enu")
PLACE_ECEF_M = np.array((-3959400.631, 3385704.533, 3667523.111))


def drawn(seed: int, status: Status) -> Solution:
    """Return a solution of which every number is another one."""
    rng = np.random.default_rng(seed)

    def covariance() -> NDArray[np.float64]:
        half = rng.normal(size=(3, 3))
        return half @ half.T

    vectors, matrices = (
        ("velocity_ecef_mps", "baseline_ecef_m"),
        ("position_cov_ecef_m2", "velocity_cov_ecef_m2ps2", "baseline_cov_ecef_m2"),
    )
    columns: dict[str, Any] = {name: rng.normal(size=3) for name in vectors} | {name: covariance() for name in matrices}
    return Solution(
        GpsTime(2100, float(rng.uniform(0.0, 604800.0))), status, position_ecef_m=PLACE_ECEF_M + rng.normal(size=3),
        base_ecef_m=PLACE_ECEF_M + 100.0, age_s=float(rng.uniform(0.0, 30.0)), ratio=float(rng.uniform(0.0, 99.0)),
        satellites_used=int(rng.integers(4, 40)), **columns,
    )  # fmt: skip


@given(st.integers(0, 2**32), st.sampled_from(Status), st.sampled_from(FORMS), st.booleans())
def test_lines_of_positions_are_the_same_from_their_part_of_a_message(seed: int, status: Status, form: Any, velocity: bool) -> None:
    solution = drawn(seed, status)
    writer = TextWriter(TextOptions(format=form, velocity=velocity and form in ("llh", "xyz")))
    whole = writer.epoch(solution_message(solution, source="", start_id="", sequence=0))
    assert writer.epoch(position_message(solution)) == whole
    assert bool(whole) == (status is not Status.NONE)


@pytest.mark.parametrize("form", FORMS)
def test_what_is_not_known_is_not_printed_from_either(form: Any) -> None:
    solution = replace(drawn(1, Status.FLOAT), base_ecef_m=np.full(3, np.nan), velocity_ecef_mps=np.full(3, np.nan))
    writer = TextWriter(TextOptions(format=form))
    assert writer.epoch(position_message(solution)) == writer.epoch(solution_message(solution, source="", start_id="", sequence=0))
