"""Another base for a session that runs: simulated bases whose truth is known; the rover is fixed before, and right through the change."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from math import inf

import numpy as np
import pytest

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.base_change import COMPARED_S, Candidate, Jump, same_antenna
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.scenario import open_stream, truth

START = GpsTime(2400, 7200.0)
RATE_HZ = 5.0
SEED = 3


def by_epoch(antenna: str, epochs: int) -> Iterator[list[Message]]:
    """Yield what comes with each epoch of an antenna."""
    decoder = StreamDecoder(StreamOptions(approximate_time=START))
    stream = open_stream("two_bases", antenna, seed=SEED, rate_hz=RATE_HZ, start=START).epochs()
    for epoch in islice(stream, epochs):
        yield [message for _, found in decoder.feed(epoch.data) for message in found]


@dataclass
class Run:
    """A session with the first base; ``step`` is an epoch of all three receivers."""

    mode: Mode = Mode.KINEMATIC
    epochs: int = 60
    shift_m: float = 0.0  # what the second base's position is wrong by
    solutions: list[Solution] = field(default_factory=list)
    jumps: list[Jump] = field(default_factory=list)

    def __post_init__(self) -> None:
        options = RtkOptions(mode=self.mode)
        self.options = SessionOptions(options, pairing_for(options, replay=False))
        self.session = Session(self.options)
        self.streams = {name: by_epoch(name, self.epochs) for name in ("rover", "base", "base2")}
        self.candidate = Candidate()
        self.used, self.now_s = "base", 0.0
        self.old_speaks = True

    def step(self) -> Solution:
        self.now_s += 1.0 / RATE_HZ
        for message in next(self.streams["base"]):
            if self.used == "base" and self.old_speaks:
                self.session.feed(Source.BASE, message, self.now_s)
        for message in next(self.streams["base2"]):
            self._second(message)
        for message in next(self.streams["rover"]):
            self.session.feed(Source.ROVER, message, self.now_s)
        found = list(self.session.solutions(self.now_s)) or list(self.session.solutions(self.now_s + 2.0))
        self.solutions += found
        if (jump := self.session.take_jump()) is not None:
            self.jumps.append(jump)
        return found[-1]

    def _second(self, message: Message) -> None:
        if isinstance(message, ReferenceStation) and message.position_ecef_m is not None:
            x, y, z = message.position_ecef_m
            message = replace(message, position_ecef_m=(x + self.shift_m, y, z))
        if self.used == "base2":
            self.session.feed(Source.BASE, message, self.now_s)
        elif not self.candidate.take(message, self.now_s):
            self.session.feed(Source.NAVIGATION, message, self.now_s)

    def change(self) -> None:
        self.session.change_base(self.options, self.candidate)
        self.used = "base2"

    def errors_m(self) -> np.ndarray:
        at = truth("two_bases", seed=SEED)
        return np.array([np.linalg.norm(s.position_ecef_m - at(s.time).antennas_ecef_m["rover"]) for s in self.solutions])


@pytest.fixture(scope="module")
def changed() -> Run:
    """A change at epoch 30 of 60."""
    run = Run()
    for _ in range(30):
        run.step()
    run.change()
    for _ in range(30):
        run.step()
    return run


def test_fixed_before_and_at_once_after_and_right_all_the_time(changed: Run) -> None:
    statuses = [solution.status for solution in changed.solutions]
    assert statuses[5:30] == [Status.FIX] * 25
    assert Status.FIX in statuses[30:33]
    assert statuses[33:] == [Status.FIX] * 27
    fixed = np.array([status is Status.FIX for status in statuses])
    assert changed.errors_m()[fixed].max() < 0.05
    moved_m = [float(np.linalg.norm(s.base_ecef_m - changed.solutions[29].base_ecef_m)) for s in changed.solutions[30:]]
    assert min(moved_m) > 3000.0


def test_velocity_and_acceleration_go_on_and_no_filter_is_reset(changed: Run) -> None:
    at = truth("two_bases", seed=SEED)
    first = changed.solutions[30]
    assert np.linalg.norm(first.velocity_ecef_mps - at(first.time).velocities_ecef_mps["rover"]) < 0.2
    assert np.sqrt(np.trace(first.acceleration_cov_ecef_m2ps4)) < 3.0  # a filter that begins has 5.2
    assert {solution.resets for solution in changed.solutions} == {changed.solutions[0].resets}


def test_the_jump_is_told_and_within_its_sigmas(changed: Run) -> None:
    last = changed.jumps[-1]
    assert last.decided
    assert last.new_status is last.old_status is Status.FIX
    assert np.linalg.norm(last.enu_m) < 0.05
    assert not any(jump.significant for jump in changed.jumps)
    assert len(changed.jumps) <= COMPARED_S * RATE_HZ + 1


@pytest.mark.parametrize("shift_m", [0.2, 3.0])
def test_a_base_with_a_wrong_position_is_warned_of_with_the_jump_it_makes(shift_m: float) -> None:
    run = Run(shift_m=shift_m)
    for _ in range(20):
        run.step()
    run.change()
    for _ in range(5):
        run.step()
    told = [jump for jump in run.jumps if jump.significant]
    assert told
    assert np.linalg.norm(told[-1].enu_m) == pytest.approx(shift_m, abs=0.05)
    # The integers are right all the same: what is wrong is the base's place and nothing else.
    assert run.errors_m()[-1] == pytest.approx(shift_m, abs=0.05)


def test_from_a_dead_base_the_change_costs_no_relative_solution() -> None:
    """The old base says nothing for two seconds, then the new one is taken: fixed at once, and compared with the old base's last epoch."""
    run = Run(epochs=40)
    for _ in range(20):
        run.step()
    run.old_speaks = False
    for _ in range(10):
        run.step()
    run.change()
    for _ in range(5):
        run.step()
    assert run.solutions[-1].status is Status.FIX
    assert run.errors_m()[-1] < 0.05
    assert run.jumps[-1].age_s == pytest.approx(2.2, abs=0.25)
    assert not run.jumps[-1].significant


def test_the_same_antenna_by_another_way_keeps_the_ambiguities() -> None:
    """The first base by a second caster: nothing begins anew, the ambiguities go on."""
    run = Run(epochs=30)
    twin = Candidate()
    feed = run.session.feed

    def both(source: Source, message: Message, now_s: float = 0.0) -> None:
        if source is Source.BASE:
            twin.take(message, now_s)
        feed(source, message, now_s)

    for _ in range(20):
        for name in ("base", "rover"):
            run.now_s += 0.1
            for message in next(run.streams[name]):
                both(Source(name), message, run.now_s)
        run.solutions += run.session.solutions(run.now_s)
    lock_s = np.nanmax(run.solutions[-1].satellites.lock_s)
    engine = run.session.engine
    run.session.change_base(run.options, twin)
    assert run.session.engine is engine
    assert run.session.same_antenna
    for name in ("base", "rover"):
        for message in next(run.streams[name]):
            run.session.feed(Source(name), message, run.now_s + 0.2)
    [solution] = run.session.solutions(run.now_s + 0.2)
    assert solution.status is Status.FIX
    assert np.nanmax(solution.satellites.lock_s) > lock_s


def test_another_receiver_at_the_same_place_is_not_the_same_antenna() -> None:
    epochs = [[m for m in found if isinstance(m, Epoch)] for found in islice(by_epoch("base", 4), 4)]
    flat = [epoch for found in epochs for epoch in found]
    other = [replace(epoch, phase_cyc=epoch.phase_cyc + 3.0) for epoch in flat]
    place = (1.0, 2.0, 3.0)
    assert same_antenna(flat, flat, (place, place))
    assert not same_antenna(flat, other, (place, place))
    assert not same_antenna(flat, flat, (place, (1.0, 2.0, 3.1)))
    assert not same_antenna(flat, flat, (place, None))
    assert not same_antenna(flat[:1], flat[1:], (place, place))


def test_without_a_base_there_are_single_solutions_and_nothing_waits() -> None:
    run = Run(epochs=20)
    for _ in range(15):
        run.step()
    run.session.change_base(run.options, None)
    run.used = ""
    solution = run.step()
    assert solution.status is Status.SINGLE
    assert run.session.take_jump() is None
    assert run.session.deadline_s() == inf


def test_a_candidate_takes_over_only_when_that_costs_no_epoch() -> None:
    epochs = [m for found in by_epoch("base2", 6) for m in found if isinstance(m, Epoch)]
    candidate = Candidate(known=(1.0, 2.0, 3.0))
    assert not candidate.serves(None, 0.025, urgent=True)
    for number, epoch in enumerate(epochs[:4], 1):
        candidate.take(epoch, 0.0)
        assert candidate.serves(None, 0.025, urgent=True)
        assert candidate.serves(None, 0.025, urgent=False) == (number >= 3)
    assert candidate.serves(epochs[3].time, 0.025, urgent=False)
    assert not candidate.serves(epochs[4].time, 0.025, urgent=False)  # the old base will have it
    assert candidate.serves(epochs[4].time, 0.025, urgent=True)
    assert not candidate.serves(epochs[0].time + -1.0, 0.025, urgent=True)


def test_moving_base_begins_anew() -> None:
    """Another moving base is another baseline: nothing of the old one goes on."""
    options = RtkOptions(mode=Mode.MOVING_BASE)
    session = Session(SessionOptions(options, pairing_for(options, replay=False)))
    streams = [by_epoch(name, 10) for name in ("rover", "heading")]
    for k, (base, rover) in enumerate(zip(*streams, strict=True)):
        for source, found in ((Source.BASE, base), (Source.ROVER, rover)):
            for message in found:
                session.feed(source, message, float(k))
        list(session.solutions(float(k)))
    assert session.engine._state is not None
    session.change_base(session.options, Candidate())
    assert session.engine._state is None
