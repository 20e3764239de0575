"""A vehicle with antennas whose solvers and receivers say what is true, with errors as told: for tests of the attitude process."""

from collections.abc import Sequence
from math import nan, radians
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles
from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef
from rtkmesh_schemas.attitude import AttitudeMessage, HeadingMessage
from rtkmesh_schemas.candidates import CandidatesMessage
from rtkmesh_schemas.config import Deployment, IngestTable, SolverTable
from rtkmesh_schemas.config_attitude import AntennaPlaceTable, AttitudeTable
from rtkmesh_schemas.keys import ATT, CANDIDATES, EVENT, HEADING, SOL, Role
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import Event
from rtkmesh_schemas.wire import Wire, decode
from rtkmesh_services.attitude.service import AttitudeService
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

WEEK = 2400
LAT_RAD, LON_RAD = radians(52.5), radians(13.4)
ORIGIN_ECEF_M = ecef_from_geodetic(LAT_RAD, LON_RAD, 80.0)
ECEF_FROM_ENU = enu_from_ecef(LAT_RAD, LON_RAD).T
SQUARE = {"a": (-1.0, -0.6, -2.0), "b": (1.0, -0.6, -2.0), "c": (-1.0, 0.6, -2.0), "d": (1.0, 0.6, -2.0)}
ANGLES_RAD = (radians(300.0), radians(3.0), radians(-6.0))
SIGMA_M = 0.004
COV = tuple((np.diag([1.0, 1.0, 4.0]) * 2.0 * SIGMA_M**2).ravel().tolist())
Vector = NDArray[np.float64]


def solution(**values: Any) -> SolutionMessage:
    """A solution that says nothing but what is told: a fix."""
    of = {int: 0, float: 0.0, str: ""}
    blank = {f.name: of.get(f.type, (nan,) * (9 if "cov" in f.name else 3)) for f in msgspec.structs.fields(SolutionMessage) if f.required}
    return SolutionMessage(**blank | {"week": WEEK, "status": 1, "status_name": "FIX"} | values)


class Vehicle:
    """An attitude process on an in-memory bus, and all that it takes from."""

    def __init__(self, places: dict[str, tuple[float, float, float]] = SQUARE, replay: bool = False, **table: Any) -> None:
        self.places = {name: np.array(place) for name, place in places.items()}
        first, *others = places
        self.baselines = {f"{first}{name}": (first, name) for name in others}
        self.baselines |= {name: (name[0], name[1]) for name in table.get("solvers", ()) if len(name) == 2}
        self.kinematic = {f"p{name}": name for name in places}
        solvers = {name: SolverTable(rover=end, base=start, mode="moving-base") for name, (start, end) in self.baselines.items()}
        solvers |= {name: SolverTable(rover=antenna, base="station") for name, antenna in self.kinematic.items()}
        source = "file://x.ubx" if replay else "sim://boat/rover"
        told = {"solvers": tuple(self.baselines), "antennas": {name: AntennaPlaceTable(position_m=place) for name, place in places.items()}}
        deployment = Deployment(
            ingest={name: IngestTable(source=source) for name in (*places, "station")},
            solver=solvers,
            attitude={"body": AttitudeTable(**told | table)},
        )
        self.clock = ManualClock()
        self.network = MemoryNetwork(self.clock)
        self.bus = MemoryBus("body", self.network)
        context = Context(id="body", role=Role.ATTITUDE, deployment=deployment, bus=self.bus, clock=self.clock)
        self.service = AttitudeService(context)
        self.life = Lifecycle(self.service, warm_in_thread=False)
        self.life.start()
        self.step()

    def step(self, seconds: float = 0.0) -> None:
        """Let time pass, and the process work."""
        self.clock.advance(seconds)
        for _ in range(12):
            self.life.step(0.0)

    def say(self, source: str, message: Wire) -> None:
        """Publish what a source says, and let the process take it."""
        stream = {HeadingMessage: HEADING, CandidatesMessage: CANDIDATES}.get(type(message), SOL)
        MemoryBus(source, self.network).publish(stream, message)
        self.step()

    def baseline(self, name: str, tow_s: float, error_m: Sequence[float] = (0.0, 0.0, 0.0), **values: Any) -> SolutionMessage:
        """What a moving-base solver says, off by an error in ENU."""
        start, end = self.baselines[name]
        ned = rotation_of_angles(*ANGLES_RAD) @ (self.places[end] - self.places[start])
        enu = tuple((NED_FROM_ENU @ ned + np.array(error_m)).tolist())
        told = {"source": name, "tow_s": tow_s, "baseline_enu_m": enu, "baseline_cov_enu_m2": COV}
        return solution(**told | values)

    def candidates(
        self, name: str, tow_s: float, right_norm: float = 4.0, wrong_norm: float = 3.0, right: bool = True, **values: Any
    ) -> CandidatesMessage:
        """Candidates of a moving-base solver: 20 wrong ones with norms from ``wrong_norm``, and among them, unless told, the right one.

        Every antenna has its integers: those of right ones close around triangles.
        """
        start, end = self.baselines[name]
        rng = np.random.default_rng(sum(map(ord, name)))
        ned = rotation_of_angles(*ANGLES_RAD) @ (self.places[end] - self.places[start])
        vectors = ned + np.vstack([np.zeros((int(right), 3)), rng.uniform(0.2, 0.6, (20, 3)) * rng.choice([-1.0, 1.0], (20, 3))])
        own = [np.random.default_rng(ord(antenna)).integers(-99, 99, 8) for antenna in (start, end)]
        integers = np.tile(own[1] - own[0], (len(vectors), 1))
        integers[int(right) :, 1:] += rng.choice([-1, 1], (20, 7))
        told = {
            "source": name, "start_id": "x", "sequence": 0, "week": WEEK, "tow_s": tow_s, "rover": end, "base": start,
            "satellite": [f"G{n:02}" for n in range(1, 9)], "signal": ["1C"] * 8, "base_signal": ["1C"] * 8, "count": 7,
            "integers": (integers - integers[:, :1]).ravel().tolist(),
            "baselines_ecef_m": (vectors @ NED_FROM_ENU @ ECEF_FROM_ENU.T).ravel().tolist(),
            "covariance_ecef_m2": tuple((2.0 * SIGMA_M**2 * np.eye(3)).ravel().tolist()),
            "norms": [right_norm] * right + np.arange(wrong_norm, wrong_norm + 20.0).tolist(), "beyond": 60.0,
            "base_ecef_m": tuple(ORIGIN_ECEF_M.tolist()),
        }  # fmt: skip
        return CandidatesMessage(**told | values)

    def position(self, name: str, tow_s: float, error_m: Sequence[float] = (0.0, 0.0, 0.0), **values: Any) -> SolutionMessage:
        """What a kinematic solver says of its antenna, off by an error in ENU."""
        enu = NED_FROM_ENU @ rotation_of_angles(*ANGLES_RAD) @ self.places[self.kinematic[name]] + np.array(error_m)
        ecef = tuple((ORIGIN_ECEF_M + ECEF_FROM_ENU @ enu).tolist())
        return solution(**{"source": name, "tow_s": tow_s, "position_ecef_m": ecef, "position_cov_enu_m2": COV} | values)

    def epoch(self, tow_s: float, without: Sequence[str] = (), errors: dict[str, Sequence[float]] | None = None) -> AttitudeMessage:
        """Let all baselines speak, those ``without`` with a float, and return the attitude."""
        for name in self.baselines:
            wrong = {"status": 2, "status_name": "FLOAT", "reason": "ratio"} if name in without else {}
            self.say(name, self.baseline(name, tow_s, (errors or {}).get(name, (0.0, 0.0, 0.0)), **wrong))
        return self.attitudes()[-1]

    def attitudes(self, stream: Any = ATT) -> list[AttitudeMessage]:
        """What was published until now."""
        return [decode(AttitudeMessage, sample.payload, sample.encoding) for sample in self.bus.sent(stream)]

    def events(self) -> list[str]:
        """The texts of what was said of antennas."""
        found = [decode(Event, s.payload, s.encoding) for level in ("info", "warning") for s in self.bus.sent(EVENT, level=level)]
        return [event.text for event in sorted(found, key=lambda event: event.sequence) if event.code == "antennas_changed"]
