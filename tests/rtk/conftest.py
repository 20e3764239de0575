"""What several tests of the engine look at."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.gnss.ephemeris import Ephemeris
from rtkmesh.gnss.epoch import Epoch

EPOCHS = 12


def load(folder: Path) -> tuple[list[Epoch], list[Epoch], Sequence[Ephemeris]]:
    """Return the first epochs of rover and base of a real pair on two bands, 5 km apart, and its ephemerides."""
    rover, base = (list(ObservationReader((folder / name).read_bytes()))[:EPOCHS] for name in ("SEPT078M1.21O", "3034078M1.21O"))
    return rover, base, read_navigation((folder / "SEPT078M.21P").read_bytes()).ephemerides


@pytest.fixture(scope="session")
def recording(data: Path) -> tuple[list[Epoch], list[Epoch], Sequence[Ephemeris]]:
    """See ``load``."""
    return load(data / "kanagawa_2021_078_60s")
