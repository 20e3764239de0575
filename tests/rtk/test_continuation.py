"""Options that change under way: the filter goes on, bit by bit the same where nothing asks for another one, and says what it kept."""

from dataclasses import replace
from itertools import islice, pairwise, zip_longest
from math import radians

import numpy as np
import pytest

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.signals import satellite_id
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.continuation import Continuation
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, IntegrityOptions, Mode, NoiseOptions, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.scenario import open_stream, truth

START = GpsTime(2400, 3600.0)
EPOCHS, CHANGED_AFTER = 24, 12
KEPT = ("position", "velocity", "ambiguities", "integers")


def messages(scenario: str, antenna: str) -> list[list[Message]]:
    """What an antenna sends, by epoch."""
    decoder = StreamDecoder(StreamOptions(approximate_time=START))
    stream = open_stream(scenario, antenna, seed=2, rate_hz=5.0, start=START).epochs()
    return [[m for _, found in decoder.feed(epoch.data) for m in found] for epoch in islice(stream, EPOCHS)]


@pytest.fixture(scope="module")
def streams() -> dict[str, dict[Source, list[list[Message]]]]:
    names = {Source.ROVER: "rover", Source.BASE: "base"}
    return {scenario: {source: messages(scenario, name) for source, name in names.items()} for scenario in ("demo", "static")}


def options_of(rtk: RtkOptions, **around: object) -> SessionOptions:
    return replace(SessionOptions(rtk, pairing_for(rtk, replay=True)), **around)


class Run:
    """A session that is fed a scenario's epochs; ``change`` is made between two of them."""

    def __init__(self, streams: dict[Source, list[list[Message]]], rtk: RtkOptions, **around: object) -> None:
        self.session, self._streams, self._next = Session(options_of(rtk, **around)), streams, 0

    def play(self, epochs: int = CHANGED_AFTER) -> list[Solution]:
        made: list[Solution] = []
        for epoch in range(self._next, self._next + epochs):
            for pair in zip_longest(*(self._streams[source][epoch] for source in (Source.BASE, Source.ROVER))):
                for source, message in zip((Source.BASE, Source.ROVER), pair, strict=True):
                    if message is not None:
                        self.session.feed(source, message)
            made += self.session.solutions()
        self._next += epochs
        return made

    def state(self) -> list[bytes]:
        """All that the filter knows."""
        state = self.session.engine._state
        assert state is not None
        return [part.tobytes() for f in (state.filter, state.informed) for part in f]


def kinematic(**changes: object) -> RtkOptions:
    return replace(RtkOptions(), **changes)


LIVE = {
    "elevation mask": {"elevation_mask_rad": radians(25.0)},
    "cn0 mask": {"cn0_mask_dbhz": 36.0},
    "excluded": {"excluded": ("G01", "E02", "C05")},
    "systems": {"systems": "GE"},
    "frequencies": {"frequencies": 1},
    "age": {"max_age_s": 5.0},
    "noise": {"noise": NoiseOptions(phase_a_m=0.004, code_ratio=100.0)},
    "ratio": {"ambiguity": AmbiguityOptions(ratio=2.0)},
    "hold": {"ambiguity": AmbiguityOptions(mode=AmbiguityMode.FIX_AND_HOLD)},
    "integrity": {"integrity": IntegrityOptions(alert_horizontal_m=0.5)},
}


@pytest.mark.parametrize("changes", list(LIVE.values()), ids=list(LIVE))
def test_the_filter_is_the_same_before_and_after_and_the_fix_goes_on(streams: dict, changes: dict[str, object]) -> None:
    run = Run(streams["demo"], kinematic())
    before = run.play()
    known, fixed = run.state(), before[-1].status
    found = run.session.go_on(options_of(kinematic(**changes)))
    assert found == Continuation(kept=KEPT)
    assert run.state() == known
    after = run.play()
    assert fixed is Status.FIX
    assert [s.status for s in after] == [Status.FIX] * len(after)
    assert {s.resets for s in after} == {0}
    told = truth("demo", seed=2)
    for solution in after:
        gap_m = np.linalg.norm(solution.position_ecef_m - told(solution.time).antennas_ecef_m["rover"])
        assert gap_m < 0.05


def used(solution: Solution) -> dict[str, float]:
    """Return the elevations (rad) of the satellites that a solution used."""
    table = solution.satellites
    names = map(satellite_id, table.satellite.tolist())
    return {n: e for n, e, state in zip(names, table.elevation_rad.tolist(), table.state.tolist(), strict=True) if state & 3}


def test_a_mask_acts_from_the_next_epoch_on(streams: dict) -> None:
    run = Run(streams["demo"], kinematic())
    low = used(run.play()[-1])
    run.session.go_on(options_of(kinematic(elevation_mask_rad=radians(30.0), excluded=("G01",))))
    high = used(run.play(1)[-1])
    assert min(low.values()) < radians(30.0) <= min(high.values())
    assert "G01" in low
    assert "G01" not in high


@pytest.mark.parametrize("modes", list(pairwise([Mode.KINEMATIC, Mode.STATIC, Mode.KINEMATIC])), ids="->".join)
def test_a_rover_that_stands_keeps_its_fix_over_a_change_of_mode(streams: dict, modes: tuple[Mode, Mode]) -> None:
    first, second = modes
    run = Run(streams["static"], kinematic(mode=first))
    before = run.play()
    found = run.session.go_on(options_of(kinematic(mode=second)))
    assert found == Continuation(kept=("position", "ambiguities", "integers"), anew=("velocity",))
    after = run.play()
    assert [s.status for s in (before[-1], *after)] == [Status.FIX] * (1 + len(after))
    steps_m = [np.linalg.norm(one.position_ecef_m - other.position_ecef_m) for one, other in pairwise([before[-1], *after])]
    assert max(steps_m) < 0.02


@pytest.mark.parametrize("name", ["age", "integrity"])
def test_the_mean_of_a_rover_that_stands_goes_on_under_other_options(streams: dict, name: str) -> None:
    """What changes nothing of its fixes changes no bit of their mean."""
    run, other = (Run(streams["static"], kinematic(mode=Mode.STATIC)) for _ in range(2))
    run.play(), other.play()
    assert not run.session.go_on(options_of(kinematic(mode=Mode.STATIC, **LIVE[name]))).obstacle
    for one, same in zip(run.play(), other.play(), strict=True):
        assert one.status is Status.FIX
        assert one.position_ecef_m.tobytes() == same.position_ecef_m.tobytes()
        assert one.position_cov_ecef_m2.tobytes() == same.position_cov_ecef_m2.tobytes()


def test_a_rover_that_may_have_moved_stands_by_its_next_fixes(streams: dict) -> None:
    """It was let move between two epochs; in the other run it was not."""
    run, other = (Run(streams["static"], kinematic(mode=Mode.STATIC)) for _ in range(2))
    run.play(), other.play()
    for mode in (Mode.KINEMATIC, Mode.STATIC):
        run.session.go_on(options_of(kinematic(mode=mode)))
    one, other_one = run.play(1)[0], other.play(1)[0]
    assert one.status is other_one.status is Status.FIX
    assert np.linalg.norm(one.position_ecef_m - other_one.position_ecef_m) > 1e-4


def test_a_fixed_position_is_taken_where_the_filter_is_and_nowhere_else(streams: dict) -> None:
    run = Run(streams["static"], kinematic())
    here = run.play()[-1].position_ecef_m
    far = kinematic(mode=Mode.FIXED, fixed_position_ecef_m=tuple(here + 20.0))
    known = run.state()
    assert "from where the filter is" in run.session.go_on(options_of(far)).obstacle
    assert run.state() == known
    near = kinematic(mode=Mode.FIXED, fixed_position_ecef_m=tuple(here))
    assert run.session.go_on(options_of(near)).anew == ("position", "velocity")
    for solution in run.play(6):
        assert solution.status is Status.FIX
        assert np.linalg.norm(solution.position_ecef_m - here) < 0.01
    assert run.session.go_on(options_of(kinematic())).kept == ("position", "ambiguities", "integers")
    assert run.play(6)[-1].status is Status.FIX


@pytest.mark.parametrize("modes", list(pairwise([Mode.MOVING_BASE, Mode.KINEMATIC, Mode.MOVING_BASE])), ids="->".join)
def test_the_baseline_does_not_jump_when_the_base_is_another_kind(streams: dict, modes: tuple[Mode, Mode]) -> None:
    """The base's own single point is metres off its configured position: the baseline stays what it is."""
    first, second = modes
    told = truth("demo", seed=2)
    configured = {"base_position_ecef_m": tuple(told(START).antennas_ecef_m["base"] + (2.0, -2.0, 1.0))}
    run = Run(streams["demo"], kinematic(mode=first), **configured)
    before = run.play()[-1]
    assert run.session.go_on(options_of(kinematic(mode=second), **configured)) == Continuation(kept=KEPT)
    after = run.play()
    assert [s.status for s in (before, *after)] == [Status.FIX] * (1 + len(after))
    assert np.linalg.norm(after[0].base_ecef_m - before.base_ecef_m) > 2.0
    for solution in after:
        places = told(solution.time).antennas_ecef_m
        assert np.linalg.norm(solution.baseline_ecef_m - (places["rover"] - places["base"])) < 0.05


REFUSED = {
    "single": (kinematic(), kinematic(mode=Mode.SINGLE)),
    "dgps": (kinematic(mode=Mode.DGPS), kinematic()),
    "length": (kinematic(mode=Mode.MOVING_BASE), kinematic(mode=Mode.MOVING_BASE, baseline_length_m=1.0)),
    "told integers": (kinematic(ambiguity=AmbiguityOptions(mode=AmbiguityMode.FIX_AND_HOLD)), kinematic()),
}


@pytest.mark.parametrize(("now", "new"), list(REFUSED.values()), ids=list(REFUSED))
def test_what_the_filter_cannot_go_on_under_changes_nothing(streams: dict, now: RtkOptions, new: RtkOptions) -> None:
    run, other = Run(streams["demo"], now), Run(streams["demo"], now)
    run.play()
    found = run.session.go_on(options_of(new))
    assert found.obstacle
    assert found.kept == ()
    assert run.session.options.rtk is now
    other.play()
    for one, same in zip(run.play(4), other.play(4), strict=True):
        assert one.position_ecef_m.tobytes() == same.position_ecef_m.tobytes()


def test_without_integers_they_are_found_anew(streams: dict) -> None:
    run = Run(streams["demo"], kinematic())
    run.play()
    off = kinematic(ambiguity=AmbiguityOptions(mode=AmbiguityMode.OFF))
    assert run.session.go_on(options_of(off)) == Continuation(kept=("position", "velocity", "ambiguities"), anew=("integers",))
    assert {s.status for s in run.play(3)} == {Status.FLOAT}
    run.session.go_on(options_of(kinematic()))
    assert run.play(6)[-1].status is Status.FIX


def test_other_antennas_need_a_fresh_filter(streams: dict) -> None:
    run = Run(streams["demo"], kinematic())
    assert run.session.go_on(options_of(kinematic(), rover_antenna="LEIAR25.R3")).obstacle


def test_a_session_without_a_filter_takes_all_that_it_may_become(streams: dict) -> None:
    """Nothing is kept where nothing is known yet, and waiting epochs wait as the new options say."""
    run = Run(streams["demo"], kinematic())
    new = kinematic(mode=Mode.STATIC)
    matched = SessionOptions(new, pairing_for(new, replay=True, maximum_wait_s=3.0, matched_only=True))
    assert run.session.go_on(matched) == Continuation()
    assert run.session.pairing.options == matched.pairing


def test_the_overview_tells_the_epoch_that_was_solved(streams: dict) -> None:
    run = Run(streams["demo"], kinematic())
    assert run.session.engine.overview().states == 0
    solution = run.play()[-1]
    overview = run.session.engine.overview()
    assert overview.states > overview.states_of_motion == 9
    assert overview.code_used.sum() >= 4
    assert set(solution.satellites.satellite.tolist()) <= set(overview.satellite.tolist())
    assert 0.0 < np.trace(overview.float_cov_m2) < 10.0
    assert 0.5 < overview.code_dilution.hdop < overview.code_dilution.pdop < overview.code_dilution.gdop < 5.0
