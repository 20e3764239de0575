"""A solver whose filter begins anew by itself says so, and by how much the position jumps."""

from dataclasses import replace
from math import isnan
from pathlib import Path

import numpy as np
import pytest
from tests.services.test_roles import RATE_HZ, World

from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh_schemas.keys import EVENT
from rtkmesh_schemas.status import Event, Level
from rtkmesh_schemas.wire import decode
from rtkmesh_services.solver.beginnings import Beginnings
from rtkmesh_services.solver.service import SolverService

PLACE = np.array([3785104.0, 901803.0, 5036926.0])
VELOCITY_MPS = np.array([3.0, -2.0, 1.0])
JUMP_ENU_M = np.array([0.5, -1.25, 2.0])
T0 = GpsTime(2400, 7200.0)


def solution(after_s: float, *, jumped_enu_m: np.ndarray | None = None, **changes: object) -> Solution:
    """A rover under way, with sigmas of 3 mm and 1 mm/s; ``jumped_enu_m`` off its way."""
    off_m = np.zeros(3) if jumped_enu_m is None else enu_from_ecef_at(PLACE).T @ jumped_enu_m
    place = PLACE + after_s * VELOCITY_MPS + off_m
    made = Solution(
        T0 + after_s,
        Status.FIX,
        position_ecef_m=place,
        position_cov_ecef_m2=9e-6 * np.eye(3),
        velocity_ecef_mps=VELOCITY_MPS,
        velocity_cov_ecef_m2ps2=1e-6 * np.eye(3),
        baseline_ecef_m=np.array([1.0, 2.0, 2.0]),
        baseline_cov_ecef_m2=4e-6 * np.eye(3),
    )
    return replace(made, **changes)


def test_the_jump_is_what_the_motion_does_not_explain() -> None:
    """Off by a known vector after 2 s on the way; its sigma is that of both places and of the velocity over the gap."""
    watch = Beginnings()
    assert watch.solved(solution(0.0), moving_base=False) is None
    begun = watch.solved(solution(2.0, jumped_enu_m=JUMP_ENU_M, resets=1), moving_base=False)
    assert begun is not None
    assert begun.enu_m == pytest.approx(JUMP_ENU_M, abs=1e-5)
    assert begun.sigma_enu_m == pytest.approx(np.full(3, np.sqrt(2 * 9e-6 + 4 * 1e-6)))
    assert begun.text == "the filter began anew: the position jumps by +0.500 E -1.250 N +2.000 U m (FIX, then FIX after 2.0 s)"
    assert begun.data["jump_enu_m"] == pytest.approx(JUMP_ENU_M.tolist(), abs=1e-5)
    assert watch.solved(solution(3.0, resets=1), moving_base=False) is None, "it is told once"


@pytest.mark.parametrize(
    ("old", "off_m", "after_s", "alarming"),
    [
        (Status.FLOAT, 0.015, 2.0, False),
        (Status.FLOAT, 0.5, 2.0, True),
        (Status.FLOAT, 0.5, 21.0, False),
        (Status.FIX, 0.0, 2.0, True),
        (Status.FIX, 0.5, 20.0, True),
    ],
)
def test_it_alarms_where_nothing_explains_it(old: Status, off_m: float, after_s: float, alarming: bool) -> None:
    """A float may jump by four of its sigmas (4.7 mm), and a long gap explains all; a fix that is given up never goes unnoticed."""
    watch = Beginnings()
    watch.solved(solution(0.0, status=old), moving_base=False)
    begun = watch.solved(solution(after_s, jumped_enu_m=np.array([off_m, 0.0, 0.0]), resets=1), moving_base=False)
    assert begun is not None
    assert begun.is_alarming is alarming


def test_what_is_not_known_alarms() -> None:
    watch = Beginnings()
    watch.solved(solution(0.0, status=Status.FLOAT), moving_base=True)
    begun = watch.solved(solution(1.0, baseline_ecef_m=np.full(3, np.nan), status=Status.SINGLE, resets=1), moving_base=True)
    assert begun is not None
    assert begun.is_alarming


def test_of_a_moving_base_it_is_the_baseline() -> None:
    watch = Beginnings()
    watch.solved(solution(0.0), moving_base=True)
    turned = np.array([1.0, 2.0, 2.5])
    begun = watch.solved(solution(1.0, jumped_enu_m=JUMP_ENU_M, baseline_ecef_m=turned, resets=1), moving_base=True)
    assert begun is not None
    assert np.linalg.norm(begun.enu_m) == pytest.approx(0.5)


def test_epochs_without_a_base_do_not_count() -> None:
    """They say nothing of resets (0); the jump is from the last place that the filter knew, to the first one after it began anew."""
    watch = Beginnings()
    watch.solved(solution(0.0, resets=2), moving_base=False)
    assert watch.solved(solution(1.0, status=Status.SINGLE, resets=0), moving_base=False) is None
    nowhere = solution(2.0, status=Status.NONE, position_ecef_m=np.full(3, np.nan), resets=3)
    assert watch.solved(nowhere, moving_base=False) is None
    begun = watch.solved(solution(3.0, resets=3), moving_base=False)
    assert begun is not None
    assert (begun.gap_s, begun.old, begun.new) == (3.0, Status.FIX, Status.FIX)
    assert begun.enu_m == pytest.approx(np.zeros(3), abs=1e-5)


def test_what_is_not_known_is_not_told_as_a_jump() -> None:
    watch = Beginnings()
    watch.solved(solution(0.0), moving_base=True)
    begun = watch.solved(solution(1.0, baseline_ecef_m=np.full(3, np.nan), status=Status.SINGLE, resets=1), moving_base=True)
    assert begun is not None
    assert isnan(begun.enu_m[0])
    assert begun.data["jump_enu_m"] is None
    assert begun.text == "the filter began anew: FIX, then SINGLE after 1.0 s"


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def events(world: World) -> list[Event]:
    found = [decode(Event, s.payload, s.encoding) for level in Level for s in world.buses["rtk"].sent(EVENT, level=level.value)]
    return [event for event in found if event.code == "filter_reset"]


def engine_of(world: World):
    service = world.lives["rtk"].service
    assert isinstance(service, SolverService)
    return service.session.engine


def test_a_filter_led_astray_is_announced(world: World) -> None:
    """A kilometre off, it begins anew within the epoch; the position of before and after are both right, and the event says so."""
    world.play(15)
    assert not events(world)
    engine_of(world)._state.filter.x[0] += 1000.0
    world.play(5)
    assert [s.resets for s in world.solutions()[-6:]] == [0, 1, 1, 1, 1, 1]
    [event] = events(world)
    assert (event.level, event.data["old_solution"], event.data["new_solution"]) == (Level.WARNING, "FIX", "FIX")
    assert event.data["gap_s"] == pytest.approx(1.0 / RATE_HZ)
    assert np.linalg.norm(event.data["jump_enu_m"]) < 0.1
    assert max(event.data["sigma_enu_m"]) < 0.1


def test_a_wrong_place_that_is_left_jumps_by_as_much(world: World) -> None:
    """What was published was wrong: the jump brings it right."""
    world.play(15)
    service = world.lives["rtk"].service
    assert isinstance(service, SolverService)
    right = service.recent.solution
    assert right is not None
    off_m = enu_from_ecef_at(right.position_ecef_m).T @ JUMP_ENU_M
    service._beginnings.solved(replace(right, position_ecef_m=right.position_ecef_m - off_m), moving_base=False)
    engine_of(world)._state.filter.x[0] += 1000.0
    world.play(1)
    [event] = events(world)
    assert event.data["jump_enu_m"] == pytest.approx(JUMP_ENU_M.tolist(), abs=0.1)


def test_behind_a_long_gap_it_is_no_warning(world: World) -> None:
    world.play(10)
    for stream in world.streams.values():
        for _ in range(round(70.0 * RATE_HZ)):
            next(stream)
    world.play(5)
    [event] = events(world)
    assert (event.level, event.data["gap_s"]) == (Level.INFO, pytest.approx(70.0 + 1.0 / RATE_HZ))


def test_a_fresh_filter_that_was_asked_for_is_no_reset(world: World) -> None:
    world.play(10)
    assert world.ask("rtk", "op=restart").ok
    world.play(5)
    assert not events(world)
