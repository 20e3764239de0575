"""Make the table of antenna calibrations that the package ships from an ANTEX file of the IGS.

  python benchmarks/antenna_table.py igs14.atx [--out engine/rtkmesh/data/antennas.atx.xz]

igs14.atx is in Debian's source package of RTKLIB (rtklib/data/ant). All receiver antennas are taken, azimuths every 30 degrees
in place of 5, variations rounded to 0.1 mm, which is far below what a type's mean says of one antenna. What that costs is printed.
"""

import argparse
import lzma
import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.antex import AntexFile, write_antex
from rtkmesh.gnss.antenna import AntennaCalibration, BandCalibration

TABLE = Path(__file__).resolve().parents[1] / "engine" / "rtkmesh" / "data" / "antennas.atx.xz"
AZIMUTH_STEP_DEG = 30.0
ROUND_M = 1e-4
LARGEST_BYTES = 300_000


def thinned(calibration: AntennaCalibration) -> AntennaCalibration:
    """Return a calibration with fewer azimuths and rounded variations."""
    if not calibration.azimuth_step_deg:
        return replace(calibration, bands=tuple(_rounded(band, 1) for band in calibration.bands))
    every = round(AZIMUTH_STEP_DEG / calibration.azimuth_step_deg)
    if every * calibration.azimuth_step_deg != AZIMUTH_STEP_DEG:
        raise SystemExit(f"{calibration.antenna}: azimuths by {calibration.azimuth_step_deg} degrees do not go into {AZIMUTH_STEP_DEG}")
    bands = tuple(_rounded(band, every) for band in calibration.bands)
    return replace(calibration, azimuth_step_deg=AZIMUTH_STEP_DEG, bands=bands)


def _rounded(band: BandCalibration, every: int) -> BandCalibration:
    return replace(band, variation_m=np.round(band.variation_m[::every] / ROUND_M) * ROUND_M)


def cost_m(whole: BandCalibration, part: BandCalibration) -> NDArray[np.float64]:
    """Return by how much (m) the thinned grid, interpolated, is off at each point of the whole one."""
    if len(whole.variation_m) == 1:
        return np.abs(whole.variation_m - part.variation_m)
    place = np.linspace(0.0, len(part.variation_m) - 1.0, len(whole.variation_m))
    index = np.minimum(place.astype(int), len(part.variation_m) - 2)
    share = (place - index)[:, None]
    return np.abs(whole.variation_m - part.variation_m[index] * (1.0 - share) - part.variation_m[index + 1] * share)


def comments(source: Path) -> list[str]:
    """Return where the table comes from."""
    text = source.read_bytes()
    return [
        f"Source: {source.name} of the International GNSS Service,",
        f"release {max(re.findall(rb'IGS[0-9]{2}_[0-9]{4}', text), default=b'not said').decode()} (its newest SINEX code, GPS week)",
        f"Made {date.today().isoformat()} by rtkmesh benchmarks/antenna_table.py",
        f"Receiver antennas only; azimuths every {AZIMUTH_STEP_DEG:.0f} degrees,",
        "variations rounded to 0.1 mm, NOAZI the mean of those",
    ]


def main() -> None:
    """Make the table and say what thinning costs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("antex", type=Path)
    parser.add_argument("--out", type=Path, default=TABLE)
    options = parser.parse_args()
    calibrations = list(AntexFile(options.antex.read_bytes()))
    thin = [thinned(calibration) for calibration in calibrations]
    text = "\n".join(line.rstrip() for line in write_antex(thin, comments(options.antex)).splitlines()) + "\n"
    data = lzma.compress(text.encode("ascii"), preset=9 | lzma.PRESET_EXTREME)
    if len(data) > LARGEST_BYTES:
        raise SystemExit(f"{len(data)} bytes are more than {LARGEST_BYTES}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_bytes(data)
    pairs = [(a, b) for one, other in zip(calibrations, thin, strict=True) for a, b in zip(one.bands, other.bands, strict=True)]
    high = np.array([cost_m(a, b)[:, :15].max() for a, b in pairs]) * 1e3  # zenith angles of 0 to 70 degrees
    print(f"{options.out}: {len(data)} bytes, {len(calibrations)} antennas, {len(pairs)} carriers")
    middle, most = np.percentile(high, [50, 95])
    print(f"largest error per carrier above 20 degrees, mm: median {middle:.2f}, p95 {most:.2f}, max {high.max():.2f}")


if __name__ == "__main__":
    main()
