"""Antennas in the engine and the session: what they move, when they count, and that unknown ones change nothing."""

from dataclasses import replace

import numpy as np
import pytest

from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.errors import OptionError
from rtkmesh.gnss.antenna import AntennaCalibration, BandCalibration
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.models.antenna import Antenna, antenna_of, null_antenna
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status

pytestmark = pytest.mark.data
BASE = np.array((-3959400.631, 3385704.533, 3667523.111))
OPTIONS = RtkOptions(systems="GEJ", frequencies=2)
EPOCHS = 6
NULL = null_antenna("ADVNULLANTENNA")


@pytest.fixture(scope="module")
def recording(data):
    folder = data / "kanagawa_2021_078_60s"
    rover, base = (list(ObservationReader((folder / name).read_bytes()))[:EPOCHS] for name in ("SEPT078M1.21O", "3034078M1.21O"))
    return rover, base, read_navigation((folder / "SEPT078M.21P").read_bytes()).ephemerides


def offset(east_m: float, north_m: float, up_m: float) -> Antenna:
    """Return an antenna whose phase centres all are at one place."""
    band = BandCalibration("G01", (east_m, north_m, up_m), np.zeros((1, 19)))
    return antenna_of(AntennaCalibration("OFFSET", "NONE", "", 5.0, 0.0, (band,)))


def solve(recording, rover: Antenna | None, base: Antenna | None) -> list[Solution]:
    engine, table = Rtk(OPTIONS), EphemerisTable()
    for ephemeris in recording[2]:
        table.add(ephemeris)
    engine.antennas(rover, base)
    return [engine.step(r, b, table, base_position_ecef_m=BASE) for r, b in zip(*recording[:2], strict=True)]


def moved_enu_m(solutions: list[Solution], others: list[Solution]) -> np.ndarray:
    assert all(s.status is Status.FIX for s in (*solutions, *others))
    turn = enu_from_ecef_at(others[0].position_ecef_m)
    return np.array([turn @ (s.position_ecef_m - o.position_ecef_m) for s, o in zip(solutions, others, strict=True)])


def test_the_rovers_phase_centre_is_above_its_reference_point(recording) -> None:
    """An offset that is the same for all carriers moves the rover by exactly its opposite, in east, north and up."""
    moved = moved_enu_m(solve(recording, offset(0.012, -0.007, 0.11), NULL), solve(recording, NULL, NULL))
    assert moved == pytest.approx(np.tile((-0.012, 0.007, -0.11), (EPOCHS, 1)), abs=2e-4)


def test_the_bases_offset_moves_the_rover_with_it(recording) -> None:
    """The base's phase centre is where the baseline begins; equal antennas five kilometres apart cancel to the earth's curvature."""
    alone = solve(recording, NULL, NULL)
    moved = moved_enu_m(solve(recording, NULL, offset(0.012, -0.007, 0.11)), alone)
    assert moved == pytest.approx(np.tile((0.012, -0.007, 0.11), (EPOCHS, 1)), abs=3e-4)
    both = moved_enu_m(solve(recording, offset(0.0, 0.0, 0.11), offset(0.0, 0.0, 0.11)), alone)
    assert np.abs(both).max() < 2e-4


def test_without_both_antennas_no_bit_changes(recording) -> None:
    """None, or one that is known, is the engine that never heard of antennas."""
    engine, table = Rtk(OPTIONS), EphemerisTable()
    for ephemeris in recording[2]:
        table.add(ephemeris)
    plain = [engine.step(r, b, table, base_position_ecef_m=BASE) for r, b in zip(*recording[:2], strict=True)]
    for rover, base in ((None, None), (offset(0.0, 0.0, 0.1), None), (None, offset(0.0, 0.0, 0.1))):
        solutions = solve(recording, rover, base)
        assert [s.position_ecef_m.tobytes() for s in solutions] == [s.position_ecef_m.tobytes() for s in plain]
        assert [s.position_cov_ecef_m2.tobytes() for s in solutions] == [s.position_cov_ecef_m2.tobytes() for s in plain]
        assert all(s.resets == 0 for s in solutions)


def test_antennas_that_correct_nothing_move_nothing(recording) -> None:
    """The zenith delay has more freedom between calibrated antennas, but places at five kilometres have nothing of it."""
    moved = moved_enu_m(solve(recording, NULL, NULL), solve(recording, None, None))
    assert np.abs(moved).max() < 1e-3


HIGH = offset(0.0, 0.0, 0.1)


def find(name: str, serial: str) -> Antenna | str:
    """Know one antenna, and the network's null antenna."""
    return {"HIGH": HIGH, "NULL": NULL}.get(name, f"no calibration of {name}{serial}")


def session_of(recording, **options: str) -> Session:
    session = Session(SessionOptions(OPTIONS, pairing_for(OPTIONS, replay=True), tuple(BASE.tolist()), find_antenna=find, **options))
    for ephemeris in recording[2]:
        session.feed(Source.BASE, ephemeris)
    return session


def station(antenna: str, serial: str = "") -> ReferenceStation:
    return ReferenceStation(0, None, 0.0, antenna, serial)


def played(recording, session: Session, *before: tuple[int, Source, ReferenceStation]) -> list[Solution]:
    """Feed both streams; each of ``before`` is put in its stream in front of that epoch."""
    for source, epochs in ((Source.BASE, recording[1]), (Source.ROVER, recording[0])):
        for index, epoch in enumerate(epochs):
            for place, where, message in before:
                if (place, where) == (index, source):
                    session.feed(source, message)
            session.feed(source, epoch)
    session.pairing.end_base()
    return list(session.solutions())


def test_names_of_the_streams_count_for_what_follows_them(recording) -> None:
    """Before both are named nothing is corrected; then the filter begins anew once, at the epoch behind the name."""
    plain = played(recording, session_of(recording))
    session = session_of(recording)
    named = played(recording, session, (0, Source.BASE, station("NULL")), (3, Source.ROVER, station("HIGH")))
    heights = moved_enu_m(named[:3], plain[:3])[:, 2], moved_enu_m(named[3:], plain[3:])[:, 2]
    assert heights[0].tolist() == [0.0, 0.0, 0.0]
    assert heights[1] == pytest.approx(-0.1, abs=5e-3)  # another filter from here on
    assert [s.resets for s in named] == [0, 0, 0, 1, 1, 1]
    assert session.corrects_antennas
    assert session.antennas == {"rover": "OFFSET NONE (other carriers as G01)", "base": "ADVNULLANTENNA"}


def test_a_name_that_is_said_again_with_more_beside_it_resets_nothing(recording) -> None:
    """A serial number without a calibration of its own, and a 1005 without name, leave the antenna as it is."""
    again = replace(station("HIGH"), antenna_serial="4711")
    session = session_of(recording)
    solutions = played(
        recording, session, (0, Source.BASE, station("NULL")), (0, Source.ROVER, station("HIGH")), (2, Source.ROVER, again),
        (4, Source.ROVER, station("")),
    )  # fmt: skip
    assert [s.resets for s in solutions] == [0] * EPOCHS
    assert session.corrects_antennas


def test_a_type_without_calibration_is_told_and_corrects_nothing(recording) -> None:
    """The other antenna being known is not enough."""
    session = session_of(recording)
    solutions = played(recording, session, (0, Source.BASE, station("HIGH")), (0, Source.ROVER, station("Patch", "7")))
    plain = played(recording, session_of(recording))
    assert [s.position_ecef_m.tobytes() for s in solutions] == [s.position_ecef_m.tobytes() for s in plain]
    assert session.antennas == {"rover": "no calibration of Patch7", "base": "OFFSET NONE (other carriers as G01)"}
    assert not session.corrects_antennas


def test_configured_names_go_before_those_of_the_streams_and_outlive_a_restart(recording) -> None:
    """What the site says counts from the first epoch on, whatever the stream says, also with a fresh filter."""
    session = session_of(recording, rover_antenna="HIGH", base_antenna="NULL")
    session.restart()
    for ephemeris in recording[2]:
        session.feed(Source.BASE, ephemeris)
    solutions = played(recording, session, (2, Source.ROVER, station("NULL")))
    assert moved_enu_m(solutions, solve(recording, NULL, NULL))[:, 2] == pytest.approx(-0.1, abs=2e-4)
    assert [s.resets for s in solutions] == [0] * EPOCHS


def test_a_configured_name_without_calibration_is_a_fault_of_the_site() -> None:
    """It is refused at once, with the key; mode single has no use for it."""
    options = SessionOptions(OPTIONS, rover_antenna="HIHG", find_antenna=find)
    with pytest.raises(OptionError, match="rover_antenna: no calibration of HIHG"):
        Session(options)
    Session(replace(options, rtk=RtkOptions(mode=Mode.SINGLE)))
