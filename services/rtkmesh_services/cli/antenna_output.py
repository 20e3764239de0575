"""What a calibration shows: tables, TOML, JSON, a picture."""

import json
import sys
from math import degrees, isfinite
from typing import TYPE_CHECKING, Any, Final

from rtkmesh_services.cli.antenna_layouts import layout_toml

if TYPE_CHECKING:
    from rtkmesh.attitude.calibration import Calibration, Consistency
    from rtkmesh_services.cli.antennas_calibrate import Request

_DISTANCE_HEADS: Final = ("between", "mean m", "sd mm", "told sd mm", "used", "of", "within 5 cm %", "alike after 1", "errors alike for s")


def written(found: "Calibration", request: "Request") -> None:
    """Print what was found and write the files that were asked for."""
    text = layout_toml(found.layout, request.name, comments(found))
    if request.out is not None:
        write_file(request.out, text.encode())
    if request.plot is not None:
        from rtkmesh_services.cli.antenna_plots import plot_calibration

        plot_calibration(found, request.plot)
    if request.as_json:
        sys.stdout.write(json.dumps(finite(figures(found)), indent=1) + "\n")
        return
    show(found)
    if request.out is None:
        sys.stdout.write("\n" + text)


def write_file(path: Any, data: bytes) -> None:
    """Write a file, whole or not at all."""
    from rtkmesh_services.cli.written_files import WrittenFile

    with WrittenFile(path) as file:
        file.write(data)


def comments(found: "Calibration") -> list[str]:
    """Return what the TOML says of where the layout is from."""
    return [
        f"rtkmesh antennas calibrate: {found.used} of {found.instants} instants, {found.shape.value};",
        "sigmas are marginal: what the axes' definition holds fixed has none; covariance_m2 is what antennas have in common.",
        *found.notes,
    ]


def show(found: "Calibration") -> None:
    """Print the tables for people."""
    from rtkmesh_services.cli.plain_table import print_table

    heads = ("antenna", "forward m", "right m", "down m", "sd mm", "sd mm", "sd mm")
    rows = zip(found.layout.names, found.layout.positions_m.tolist(), (1e3 * found.sigmas_m).tolist(), strict=True)
    print_table(heads, [(name, *(f"{v:.4f}" for v in place), *(f"{v:.1f}" for v in sigma)) for name, place, sigma in rows], right=heads[1:])
    print_table(_DISTANCE_HEADS, [_distance_cells(row) for row in found.distances], right=_DISTANCE_HEADS[1:])
    sys.stdout.write("".join(f"{line}\n" for line in summary(found)))


def summary(found: "Calibration") -> list[str]:
    """Return what else is to be said, a line each."""
    dropped = f"{found.wrong_distance} by distances, {found.wrong_chi_square} by chi-square; {found.reduced} lost an antenna"
    lines = [
        f"instants: {found.used} of {found.instants} used; left out {dropped}",
        f"true sigmas by told ones: {_factor(found.scale_horizontal)} horizontally, {_factor(found.scale_vertical)} vertically",
        f"chi-square after that: {found.chi_square:.0f} for {found.degrees} degrees of freedom",
        f"noise is not white: variances of the layout are up to {found.variance_factor:.1f} times those of independent instants",
        f"shape: {found.shape.value}",
        f"mean tilt of the axes: pitch {degrees(found.mean_pitch_rad):.2f}, roll {degrees(found.mean_roll_rad):.2f} deg",
    ]
    if isfinite(found.thickness_m):
        flat = "flat within the noise" if found.thickness_m < 3.0 * found.thickness_sigma_m else "not flat"
        lines.append(f"off the best plane: {1e3 * found.thickness_m:.1f} mm, sigma {1e3 * found.thickness_sigma_m:.1f} mm: {flat}")
    return [*lines, *(f"note: {note}" for note in found.notes)]


def _factor(value: float) -> str:
    return f"{value:.2f}" if isfinite(value) else "not seen"


def _distance_cells(row: "Consistency") -> tuple[str, ...]:
    middle = f"{row.mean_m:.4f}", f"{1e3 * row.sd_m:.1f}", f"{1e3 * row.told_m:.1f}", str(row.used), str(row.count)
    return f"{row.names[0]} {row.names[1]}", *middle, f"{row.within_pct:.1f}", f"{row.lag_one:.2f}", f"{row.correlation_s:.1f}"


def figures(found: "Calibration") -> dict[str, Any]:
    """Return everything for programs."""
    from dataclasses import asdict

    assert found.layout.cov_m2 is not None
    places = {"antennas": list(found.layout.names), "positions_m": found.layout.positions_m.tolist(), "sigmas_m": found.sigmas_m.tolist()}
    plain = {name: getattr(found, name) for name in found.__slots__ if name not in ("layout", "distances", "shape", "notes")}
    joint = {"covariance_m2": found.layout.cov_m2.tolist(), "shape": found.shape.value, "notes": list(found.notes)}
    return {**places, **plain, **joint, "distances": [asdict(row) for row in found.distances]}


def finite(value: Any) -> Any:
    """Return a value in which NaN and infinity, which JSON has not, are null."""
    if isinstance(value, float):
        return value if isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(part) for key, part in value.items()}  # pyright: ignore[reportUnknownVariableType]
    return [finite(part) for part in value] if isinstance(value, list | tuple) else value  # pyright: ignore[reportUnknownVariableType]
