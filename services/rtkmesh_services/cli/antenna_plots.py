"""Pictures of layouts, with matplotlib where it is installed (``pip install rtkmesh[plot]``)."""

from math import degrees, pi
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.design import Design, Noise, design
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh_services.errors import SourceError

if TYPE_CHECKING:
    from rtkmesh.attitude.calibration import Calibration

Matrix = NDArray[np.float64]

_SIZES: Final = np.geomspace(0.2, 5.0, 40)
_AROUND: Final = np.linspace(0.0, 2.0 * pi, 73)


def figure(columns: int) -> tuple[Any, Any]:
    """Return an empty figure and its axes, drawn without a screen; SourceError where matplotlib is not there."""
    try:
        from matplotlib.figure import Figure  # pyright: ignore[reportMissingImports, reportUnknownVariableType]
    except ImportError as error:
        raise SourceError("--plot needs matplotlib: pip install 'rtkmesh[plot]'") from error
    made: Any = Figure(figsize=(5.0 * columns, 5.0), layout="constrained")
    return made, np.atleast_1d(made.subplots(1, columns))


def save(made: Any, path: Path) -> None:
    """Write a figure; SourceError where it cannot be written, or has a name of no known kind."""
    try:
        made.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: {error}") from error


def plot_calibration(found: "Calibration", path: Path) -> None:
    """Draw the layout from above with its error ellipses, enlarged, and how the distances repeat."""
    made, (top, bars) = figure(2)
    layout = found.layout
    largest = max(float(found.sigmas_m[:, :2].max()), 1e-6)
    scale = 0.1 * max(float(np.ptp(layout.positions_m[:, :2], axis=0).max()), 1e-3) / largest
    top_view(top, layout, layout.cov_m2, scale)
    top.set_title(f"from above; 1-sigma ellipses x {scale:.0f}")
    names = [f"{row.names[0]}-{row.names[1]}" for row in found.distances]
    bars.bar(names, [1e3 * row.sd_m for row in found.distances], label="measured")
    bars.plot(names, [1e3 * row.told_m for row in found.distances], "k_", markersize=20, label="told")
    bars.set_ylabel("sd of the distance, mm")
    bars.legend()
    save(made, path)


def top_view(axes: Any, layout: Layout, cov_m2: Matrix | None, scale: float) -> None:
    """Draw antennas from above, nose up, with ellipses of their horizontal covariance, ``scale`` times as large."""
    for i, (name, (forward, right, down)) in enumerate(zip(layout.names, layout.positions_m.tolist(), strict=True)):
        axes.plot(right, forward, "o", color=f"C{i}")
        axes.annotate(
            f"{name} ({-down:+.2f} up)" if abs(down) > 5e-3 else name, (right, forward), xytext=(6, 6), textcoords="offset points"
        )
        if cov_m2 is not None:
            ring = ellipse(cov_m2[3 * i : 3 * i + 2, 3 * i : 3 * i + 2]) * scale
            axes.plot(right + ring[:, 1], forward + ring[:, 0], "-", color=f"C{i}", linewidth=1.0)
    axes.set_xlabel("right, m")
    axes.set_ylabel("forward, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(visible=True, alpha=0.3)
    axes.margins(0.25)


def ellipse(cov: Matrix) -> Matrix:
    """Return the 1-sigma ellipse (k, 2) of a covariance (2x2)."""
    values, vectors = np.linalg.eigh(cov)
    return (np.column_stack([np.cos(_AROUND), np.sin(_AROUND)]) * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def plot_designs(designs: dict[str, tuple[Layout, Design]], noise: Noise, path: Path) -> None:
    """Draw every layout from above with the noise of its antennas, the angles' sigmas side by side, and heading by size."""
    made, axes = figure(len(designs) + 2)
    for place, (name, (layout, _)) in zip(axes, designs.items(), strict=False):
        scale = 0.1 * max(float(np.ptp(layout.positions_m[:, :2], axis=0).max()), 1e-3) / noise.horizontal_m
        top_view(place, layout, noise.cov_m2(len(layout.names)), scale)
        place.set_title(f"{name}; ellipses x {scale:.0f}")
    angle_bars(axes[-2], {name: made_design for name, (_, made_design) in designs.items()})
    for name, (layout, _) in designs.items():
        axes[-1].plot(_SIZES, heading_by_size(layout, noise), label=name)
    axes[-1].set_xlabel("largest distance of two antennas, m")
    axes[-1].set_ylabel("sigma of heading, deg")
    axes[-1].set_yscale("log")
    axes[-1].grid(visible=True, which="both", alpha=0.3)
    axes[-1].legend()
    save(made, path)


def angle_bars(axes: Any, designs: dict[str, Design]) -> None:
    """Draw the sigmas of heading, pitch and roll of all layouts side by side."""
    width = 0.8 / len(designs)
    for i, (name, made) in enumerate(designs.items()):
        sigmas = [degrees(value) for value in (made.whole.heading_rad, made.whole.pitch_rad, made.whole.roll_rad)]
        axes.bar(np.arange(3) + i * width, np.nan_to_num(sigmas), width, label=name)
    axes.set_xticks(np.arange(3) + 0.4 - 0.5 * width, ["heading", "pitch", "roll"])
    axes.set_ylabel("sigma, deg (none: not seen)")
    axes.legend()


def heading_by_size(layout: Layout, noise: Noise) -> Matrix:
    """Return the sigma of heading (deg) of a layout of these sizes (its largest distance)."""
    between = layout.positions_m[:, None] - layout.positions_m[None, :]
    unit = layout.positions_m / float(np.linalg.norm(between, axis=2).max())
    sigma = design(Layout(layout.names, unit), noise, np.zeros(3)).whole.heading_rad
    return degrees(sigma) / _SIZES
