"""Calibrations of receiver antennas: where the phase centre of each carrier is, by direction."""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

NO_RADOME: Final = "NONE"


@dataclass(frozen=True, slots=True, eq=False)
class BandCalibration:
    """Phase centre of one carrier: mean offset from the antenna reference point and variation about it.

    ``frequency`` is ANTEX's code, system letter and RINEX band (``G01``). ``offset_enu_m`` in the antenna's frame, its north mark
    to the north. ``variation_m`` (azimuths x zenith angles) is added to the range; one row where azimuth does not matter.
    """

    frequency: str
    offset_enu_m: tuple[float, float, float]
    variation_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class AntennaCalibration:
    """Calibration of an antenna type with its radome, or of the one antenna with this serial number.

    The grid of all bands: zenith angles 0, step, ...; azimuths 0, step, ..., 360 degrees clockwise from north (step 0: none).
    """

    antenna: str
    radome: str
    serial: str
    zenith_step_deg: float
    azimuth_step_deg: float
    bands: tuple[BandCalibration, ...]


class Calibrations(Protocol):
    """A table of calibrations."""

    def find(self, antenna: str, radome: str, serial: str = "") -> AntennaCalibration | None:
        """Return the calibration of an antenna type with this radome, None if there is none."""
        ...


def antenna_name(text: str) -> tuple[str, str]:
    """Return antenna type and radome of an IGS name such as ``LEIAR25.R3      LEIT``; NONE where it has no radome.

    IGS rcvr_ant.tab: the type in columns 1 to 15, the radome in 17 to 20. Any number of blanks may stand between; case does not matter.
    """
    words = text.upper().split()
    if len(words) > 1 and len(words[-1]) == 4:
        return " ".join(words[:-1]), words[-1]
    return " ".join(words), NO_RADOME
