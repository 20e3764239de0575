"""Layouts of antennas by name, of one size: the paper's optimal ones and other usual ones, in the body's forward-right-down axes.

The paper has the right angle as the best of three; that neglects that two sides share an antenna. The sum of the variances of the plane's
normal is smallest at 74.5 degrees (2 + sqrt(3) instead of 4). Source: seed_systems.md 3.2.
"""

from collections.abc import Callable
from math import acos, cos, pi, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.errors import OptionError

Places = list[tuple[float, float, float]]

BEST_APEX_RAD: Final = acos(2.0 - sqrt(3.0))  # 74.5 degrees: d/dg (4 - 2 cos g) / sin^2 g = 0
_NAMES: Final = "abcdefgh"


def _apex(angle_rad: float) -> Places:
    """Two sides of one length that meet in the first antenna, symmetrical about the nose."""
    half = 0.5 * angle_rad
    return [(0.0, 0.0, 0.0), (cos(half), -sin(half), 0.0), (cos(half), sin(half), 0.0)]


def _ring(antennas: int) -> Places:
    """On a circle of radius 1, the first ahead."""
    return [(cos(2.0 * pi * k / antennas), sin(2.0 * pi * k / antennas), 0.0) for k in range(antennas)]


_SQUARE: Final[Places] = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0)]
PRESETS: Final[dict[str, tuple[Callable[[], Places], str]]] = {
    "pair": (lambda: _SQUARE[:2], "two antennas along the nose, SIZE apart"),
    "line": (lambda: [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0)], "three on a line of SIZE: the turn about it is not seen"),
    "right-angle": (lambda: _SQUARE[:3], "three, sides of SIZE: the paper's optimum (the exact one is best-angle)"),
    "best-angle": (lambda: _apex(BEST_APEX_RAD), "three, sides of SIZE at 74.5 degrees: the smallest variance of the plane's normal"),
    "triangle": (lambda: _apex(pi / 3.0), "three, equilateral, sides of SIZE: the best worst axis"),
    "square": (lambda: list(_SQUARE), "four, sides of SIZE"),
    "cube-corner": (
        lambda: [*_SQUARE[:3], (0.0, 0.0, -1.0)],
        "four, three sides of SIZE from one corner, one up: the paper's optimum",
    ),
    "raised": (lambda: [*_SQUARE, (0.5, 0.5, -0.5)], "a square of SIZE and a fifth antenna above its middle: vertical faults are seen"),
    "pentagon": (lambda: _ring(5), "five on a circle of radius SIZE"),
    "hexagon": (lambda: _ring(6), "six on a circle of radius SIZE"),
}


def preset(name: str, size_m: float) -> Layout:
    """Return a layout by name, ``size_m`` metres large; OptionError for an unknown name or no size."""
    if name not in PRESETS:
        raise OptionError(f"there is no layout '{name}': {', '.join(PRESETS)}")
    if not 0.0 < size_m < 1e4:
        raise OptionError(f"a layout is larger than 0 m, not {size_m:g} m")
    places: NDArray[np.float64] = size_m * np.array(PRESETS[name][0]())
    return Layout(tuple(_NAMES[: len(places)]), places)
