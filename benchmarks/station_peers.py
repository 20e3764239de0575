"""Stations as RINEX files, and RTKLIB's programs on them: with the options of short baselines, and with the atmosphere as states."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import rtklib
from peers import DEMO5, installed
from rtkmesh.codecs.rinex_navigation_write import navigation_header, navigation_record
from rtkmesh.codecs.rinex_observation_write import Equipment, ObservationWriter, Survey
from rtkmesh.gnss.ephemeris import Ephemeris
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s
from rtkmesh.simulation.sky import KLOBUCHAR
from score_pos import Track
from simulated_files import ORIGIN, Files, by_demo5, by_rnx2rtkp

_STATES: Final = "pos1-ionoopt=est-stec\npos1-tropopt=est-ztd\n"


@dataclass(frozen=True, slots=True)
class StationPeer:
    """Another program with its options."""

    name: str
    ambiguities: str
    further: str = ""
    demo5: bool = False

    def solve(self, files: Files, systems: str, base_ecef_m: Iterable[float], start: GpsTime, seconds: float) -> Track | None:
        """Return its solutions; None where it has none."""
        options = rtklib.plain_options("kinematic", systems, 2, self.ambiguities, demo5=self.demo5) + self.further
        options += rtklib.base_options(base_ecef_m)
        return (by_demo5 if self.demo5 else by_rnx2rtkp)(start, files, options, (0.0, seconds))


_PEERS: Final = (
    StationPeer("b34 continuous", "continuous"),
    StationPeer("b34 continuous, states", "continuous", _STATES),
    StationPeer("demo5 recommended", "fix-and-hold", DEMO5, demo5=True),
    StationPeer("demo5 recommended, states", "fix-and-hold", DEMO5 + _STATES, demo5=True),
)


def station_peers() -> list[StationPeer]:
    """Return the programs that are there."""
    there = {peer.demo5 for peer in installed()}
    return [peer for peer in _PEERS if peer.demo5 in there]


def written(rover: list[Epoch], base: list[Epoch], ephemerides: Iterable[Ephemeris], folder: Path) -> Files:
    """Write the epochs of both stations and the ephemerides of all hours as RINEX."""
    for name, epochs in (("rover", rover), ("base", base)):
        survey = Survey()
        for epoch in epochs:
            survey.add(epoch)
        writer = ObservationWriter(survey, ORIGIN, Equipment(name))
        (folder / f"{name}.obs").write_bytes(b"".join((writer.header().encode("ascii"), *map(writer.epoch, epochs))))
    header = navigation_header(ORIGIN, [KLOBUCHAR], gps_minus_utc_s(rover[0].time))
    (folder / "all.nav").write_text(header + "".join(navigation_record(one, ORIGIN.version) for one in ephemerides))
    return Files(folder, folder / "rover.obs", folder / "base.obs", (folder / "all.nav",))
