"""Writes the geoid table of the texts: `python benchmarks/geoid_table.py`.

The heights are EGM96's (NGA, public domain), at whole degrees, as RTKLIB carries them; they are read from RTKLIB itself, through
pyrtklib5's geoidh at the points of the grid. The file holds millimetres: differences along each parallel from 0 to 360 degrees east,
parallels from south to north, 16 bits big endian, xz.
"""

import lzma
import sys
from math import radians
from pathlib import Path

import numpy as np
import pyrtklib5 as rtklib

TARGET = Path(__file__).parent.parent / "services/rtkmesh_services/texts/egm96.xz"
INSIDE = 1e-9  # degrees: RTKLIB refuses 360 and what rounding puts beyond the poles


def heights_mm() -> np.ndarray:
    """Return the heights of the grid, south to north, 0 to 360 degrees east."""
    place = rtklib.Arr1Ddouble(3)
    table = np.empty((181, 361), int)
    for row in range(181):
        place[0] = radians(min(max(row - 90.0, -90.0 + INSIDE), 90.0 - INSIDE))
        for column in range(361):
            place[1] = radians(min(float(column), 360.0 - INSIDE))
            height_mm = 1e3 * rtklib.geoidh(place)
            table[row, column] = round(height_mm)
            if abs(height_mm - table[row, column]) > 0.01:
                sys.exit(f"{row - 90} N {column} E: {height_mm} mm is no whole number of millimetres")
    return table


def main() -> None:
    """Write the file."""
    differences = np.diff(heights_mm(), axis=1, prepend=0)
    # The first of a parallel may not fit into 16 bits: it is told from the parallel before.
    differences[1:, 0] -= differences[:-1, 0]
    if abs(differences).max() > 0x7FFF:
        sys.exit("a difference does not fit into 16 bits")
    TARGET.write_bytes(lzma.compress(differences.astype(">i2").tobytes(), preset=9 | lzma.PRESET_EXTREME))
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
