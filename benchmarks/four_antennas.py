#!/usr/bin/env python3
"""Attitude of a frame with four antennas in motion: a recording of the UPV in Valencia (upv_four_antenna), receivers' own RTK positions.

  four_antennas.py [--data DIR] [--quick] [--json]

The layout is calibrated from the recording itself; then every epoch with three antennas or more is fitted, judged, and compared with the
author's angles and with those of an inertial system on the same vehicle. Faults are put into epochs of four antennas that are right, and
antennas taken away. Angles in degrees, lengths in mm. Positions are of receivers that share one virtual base.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cases import data_folder
from results import table
from rtkmesh.attitude.calibration import Calibration, Instant, calibrate
from rtkmesh.attitude.design import Noise, design
from rtkmesh.attitude.integrity import Finding, Judged, judged
from rtkmesh.attitude.protection import Guarding, levels
from rtkmesh.attitude.rigid_body import Fit, Layout, Measured, fit
from rtkmesh.attitude.rotation import NED_FROM_ENU, angles_of, rotation_of_angles, vector_of, wrapped
from score_pos import ecef_from_geodetic, enu_from_ecef_at

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Row = dict[str, Any]

FOLDER: Final = "upv_four_antenna"
ANTENNAS: Final = ("2", "3", "5", "4")  # around the frame
FAULTS_M: Final = (0.05, 0.1, 0.2, 0.5, 1.0)
WITHIN: Final = 3.4  # sigmas of an angle: one in 1500 is further off
GUARDING: Final = Guarding()  # a risk of 1e-5; a fault of an antenna in 1e-4 of the epochs: of those with one, levels may miss 1.3 %
_SHARES: Final = ("found", "right", "wrong", "given", "outside", "beyond")
_GIVEN: Final = (Finding.OK, Finding.EXCLUDED)
_SHIFTS_S: Final = np.arange(-20.0, 20.5, 0.5)
_ALIGNING_S: Final = 60  # the inertial system's heading begins at zero
_STANDING_MPS: Final = 0.005
_SAME: Final = 3e-3  # axes with a smaller share of the gained variance are not told apart


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Epochs of the receivers by second of day, and angles (heading, pitch, roll; rad) of author and inertial system with their times."""

    instants: list[Instant]
    author: Matrix  # (n, 4): second of day, heading, pitch, roll
    inertial: Matrix
    standing_s: set[int]


def read(folder: Path) -> Recording:
    """Return the recording: positions in NED at the first one. Formats: gnss_readme.txt and ins_readme.txt beside it."""
    tables = [np.loadtxt(folder / f"VRS-TR8-REC{name}_0.geo") for name in ANTENNAS]
    origin = ecef_from_geodetic(tables[0][:1, 6:9])[0]
    turn = NED_FROM_ENU @ enu_from_ecef_at(origin)
    found: dict[int, dict[int, tuple[Vector, Vector]]] = {}
    for antenna, rows in enumerate(tables):
        places = (ecef_from_geodetic(rows[:, 6:9]) - origin) @ turn.T
        for second, place, sigma in zip(seconds(rows), places, rows[:, 9:12], strict=True):
            found.setdefault(round(second), {})[antenna] = place, sigma
    author, inertial = (np.loadtxt(folder / name) for name in ("VRS-20-10-2022_ses0.geo", "INS-20-10-2022_ses0.geo"))
    speed = np.loadtxt(folder / "VRS-20-10-2022_ses0.kin")
    standing = {round(s) for s, v in zip(seconds(speed), np.abs(speed[:, 9:12]).max(axis=1), strict=True) if v < _STANDING_MPS}
    instants = [Instant(float(second), _measured(seen)) for second, seen in sorted(found.items())]
    return Recording(instants, _angles(author[author[:, -1] >= 3.0]), _angles(inertial), standing)


def _measured(seen: dict[int, tuple[Vector, Vector]]) -> Measured:
    numbers = sorted(seen)
    values, sigmas = np.array([seen[k][0] for k in numbers]), np.concatenate([seen[k][1] for k in numbers])
    return Measured(np.eye(len(ANTENNAS))[numbers], values, np.diag(np.maximum(sigmas, 1e-3) ** 2))


def seconds(rows: Matrix) -> Vector:
    return rows[:, 3] * 3600.0 + rows[:, 4] * 60.0 + rows[:, 5]


def _angles(rows: Matrix) -> Matrix:
    roll, pitch, heading = np.radians(rows[:, 12:15]).T
    return np.column_stack([seconds(rows), heading, pitch, roll])


def scaled(instant: Instant, found: Calibration) -> Instant:
    """Return an instant with sigmas as large as the calibration found them to be."""
    axes = np.tile([found.scale_horizontal, found.scale_horizontal, found.scale_vertical], len(instant.measured.weights))
    return Instant(instant.time_s, replace(instant.measured, cov_m2=instant.measured.cov_m2 * np.outer(axes, axes)))


def antennas_of(instant: Instant) -> int:
    return int(instant.measured.seen.sum())


def verdicts(layout: Layout, instants: Sequence[Instant]) -> dict[int, Judged]:
    """Return what is made of every epoch with three antennas or more."""
    return {round(i.time_s): judged(layout, i.measured) for i in instants if antennas_of(i) >= 3}


# --- against the others ---


def against(ours: dict[int, Judged], theirs: Matrix) -> Row:
    """Return how angles differ from ours: time offset, constant rotation between the frames, and the spread before and after that."""
    shift_s = min(_SHIFTS_S, key=lambda shift: _spread(paired(ours, theirs, shift)))
    before, pairs = paired(ours, theirs, 0.0), paired(ours, theirs, shift_s)
    constant = mean_rotation([mine.T @ other for mine, other in pairs])
    after = [(mine @ constant, other) for mine, other in pairs]
    heading, pitch, roll = np.degrees([wrapped(angle) for angle in angles_of(constant)])
    return {
        "epochs": len(pairs),
        "time offset s": float(shift_s),
        "frames": f"{heading:.2f} / {pitch:.2f} / {roll:.2f}",
        "rms before": _rms(before),
        "rms after": _rms(after),
        "median after": _median(after),
        "within 3 deg %": round(100.0 * float(np.mean(np.abs(differences_deg(after)).max(axis=1) < 3.0)), 1),
    }


def only(ours: dict[int, Judged], recording: Recording, antennas: int) -> dict[int, Judged]:
    """Return the verdicts of epochs of so many antennas."""
    return {s: ours[s] for s in (round(i.time_s) for i in recording.instants if antennas_of(i) == antennas)}


def paired(ours: dict[int, Judged], theirs: Matrix, shift_s: float) -> list[tuple[Matrix, Matrix]]:
    """Return our rotations with theirs of ``shift_s`` later by their clock, interpolated over a second."""
    times, found = theirs[:, 0], list[tuple[Matrix, Matrix]]()
    unwrapped = np.unwrap(theirs[:, 1:], axis=0)
    for second, verdict in ours.items():
        at = second + shift_s
        k = int(np.searchsorted(times, at - 0.01))
        given = verdict.fit is not None and verdict.finding in (Finding.OK, Finding.EXCLUDED)
        if not given or k >= len(times) or (k == 0 and times[0] > at + 0.02):
            continue
        j = k if times[k] - at < 0.02 else k - 1
        if times[k] - times[j] > 1.1:
            continue
        share = 0.0 if j == k else (at - times[j]) / (times[k] - times[j])
        assert verdict.fit is not None
        found.append((verdict.fit.ned_from_body, rotation_of_angles(*((1.0 - share) * unwrapped[j] + share * unwrapped[k]))))
    return found


def mean_rotation(rotations: Sequence[Matrix]) -> Matrix:
    """Return the rotation that is nearest to all, outliers left out (those further off than 4 medians)."""
    kept = list(rotations)
    for _ in range(3):
        u, _, vt = np.linalg.svd(np.mean(kept, axis=0))
        mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        off = np.array([np.linalg.norm(vector_of(mean.T @ rotation)) for rotation in rotations])
        kept = [rotation for rotation, far in zip(rotations, off, strict=True) if far <= 4.0 * np.median(off)]
    return mean


def _spread(pairs: list[tuple[Matrix, Matrix]]) -> float:
    """Return how far the middle difference of the frames is from constant."""
    between = [mine.T @ other for mine, other in pairs]
    mean = mean_rotation(between)
    return float(np.median([np.linalg.norm(vector_of(mean.T @ rotation)) for rotation in between]))


def differences_deg(pairs: list[tuple[Matrix, Matrix]]) -> Matrix:
    """Return theirs minus ours (n, 3): heading, pitch, roll."""
    return np.degrees([[wrapped(b - a) for a, b in zip(angles_of(mine), angles_of(other), strict=True)] for mine, other in pairs])


def _rms(pairs: list[tuple[Matrix, Matrix]]) -> str:
    return " / ".join(f"{value:.2f}" for value in np.sqrt(np.mean(np.square(differences_deg(pairs)), axis=0)))


def _median(pairs: list[tuple[Matrix, Matrix]]) -> str:
    return " / ".join(f"{value:.2f}" for value in np.median(np.abs(differences_deg(pairs)), axis=0))


# --- what the positions share ---


def shared(recording: Recording) -> Row:
    """Return how alike the errors of two receivers are while the frame stands: what they share is the base's."""
    runs = _standing_runs(recording)
    own, common, count = np.zeros(3), np.zeros(3), 0
    for rows in runs:
        values = np.array([i.measured.values_ned_m for i in rows])
        off = values - values.mean(axis=0)
        for j, k in combinations(range(values.shape[1]), 2):
            own += 0.5 * (np.square(off[:, j]) + np.square(off[:, k])).sum(axis=0)
            common += (off[:, j] * off[:, k]).sum(axis=0)
            count += len(rows)
    correlation = common / np.maximum(own, 1e-300)
    sigma = 1e3 * np.sqrt(own / max(count, 1))
    return {"stretches": len(runs), "seconds": sum(map(len, runs)), "sd": sigma.tolist(), "correlation": correlation.tolist()}


def _standing_runs(recording: Recording) -> list[list[Instant]]:
    """Return stretches of ten seconds or more that stand, with the same antennas."""
    runs: list[list[Instant]] = [[]]
    for instant in recording.instants:
        last = runs[-1][-1] if runs[-1] else None
        same = last is not None and instant.time_s - last.time_s < 1.5 and np.array_equal(instant.measured.weights, last.measured.weights)
        if round(instant.time_s) not in recording.standing_s:
            runs.append([])
        elif same or last is None:
            runs[-1].append(instant)
        else:
            runs.append([instant])
    return [run for run in runs if len(run) >= 10 and antennas_of(run[0]) >= 2]


def with_shared(instant: Instant, correlation: Vector) -> Instant:
    """Return an instant whose positions share part of their errors: it cancels in attitude and stays in the position."""
    measured = instant.measured
    root = np.sqrt(np.diag(measured.cov_m2)).reshape(-1, 3)
    n = len(root)
    alike = np.einsum("jk,i->jki", np.ones((n, n)), correlation) + np.einsum("jk,i->jki", np.eye(n), 1.0 - correlation)
    joint = np.einsum("ji,ki,jki,im->jikm", root, root, alike, np.eye(3)).reshape(3 * n, 3 * n)
    return Instant(instant.time_s, replace(measured, cov_m2=joint))


# --- faults and losses ---


def faults(layout: Layout, instants: Sequence[Instant], lost: int, rng: np.random.Generator) -> Iterator[Row]:
    """Yield, per direction and size of a fault of one antenna, how often it is found, told whose, and what the output then is."""
    for direction in ("horizontal", "vertical"):
        for size_m in FAULTS_M:
            rows = [_one_fault(layout, instant, direction, size_m, lost, rng) for instant in instants]
            yield {"lost": lost, "direction": direction, "size_m": size_m, "epochs": len(rows), **_counted([row for row in rows if row])}


def _one_fault(layout: Layout, instant: Instant, direction: str, size_m: float, lost: int, rng: np.random.Generator) -> Row:
    order = rng.permutation(len(ANTENNAS))
    faulty, gone = int(order[0]), [int(k) for k in order[1 : 1 + lost]]
    clean = fit(layout, instant.measured)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    fault = size_m * (np.array([0.0, 0.0, 1.0]) if direction == "vertical" else np.array([np.cos(angle), np.sin(angle), 0.0]))
    values = instant.measured.values_ned_m.copy()
    values[faulty] += fault
    measured = replace(instant.measured, values_ned_m=values)
    for antenna in gone:
        measured = measured.without(antenna)
    verdict = judged(layout, measured, start=clean.ned_from_body if clean else None)
    if clean is None or verdict.fit is None:
        return {}
    return _outcome(verdict, clean, ANTENNAS[faulty]) | _by_level(verdict, clean, levels(layout, measured, verdict, GUARDING).rad)


def _by_level(verdict: Judged, clean: Fit, levels_rad: Vector) -> Row:
    """Return whether an angle of an attitude that passed is beyond its protection level, and the levels (deg)."""
    assert verdict.fit is not None
    off = np.abs([wrapped(a - b) for a, b in zip(verdict.fit.angles_rad, clean.angles_rad, strict=True)])
    return {"beyond": verdict.finding in _GIVEN and bool(np.any(off > levels_rad)), "levels_deg": np.degrees(levels_rad).tolist()}


def _outcome(verdict: Judged, clean: Fit, faulty: str) -> Row:
    assert verdict.fit is not None
    given = verdict.finding in _GIVEN
    return {
        "found": verdict.finding is not Finding.OK,
        "right": verdict.excluded == (faulty,),
        "wrong": verdict.finding is Finding.EXCLUDED and verdict.excluded != (faulty,),
        "given": given,
        "outside": given and sigmas_off(verdict.fit, clean) > WITHIN,
        "error_deg": float(np.degrees(np.linalg.norm(seen_error(verdict.fit, clean)))),
    }


def seen_error(found: Fit, clean: Fit) -> Vector:
    """Return the rotation (rad, NED) between two fits, without what a line of antennas does not see."""
    off = vector_of(found.ned_from_body @ clean.ned_from_body.T)
    return off if found.unseen_ned is None else off - found.unseen_ned * float(off @ found.unseen_ned)


def sigmas_off(found: Fit, clean: Fit) -> float:
    """Return the largest of the errors along the principal axes of the told covariance, in its sigmas."""
    values, vectors = np.linalg.eigh(found.cov[:3, :3])
    seen = values > 1e-9 * values[-1]
    return float(np.max(np.abs(vectors[:, seen].T @ seen_error(found, clean)) / np.sqrt(values[seen])))


def _counted(rows: list[Row]) -> Row:
    share = {name: 100.0 * float(np.mean([row[name] for row in rows])) for name in _SHARES}
    given = [row for row in rows if row["given"]]
    middle = np.median([row["levels_deg"] for row in given], axis=0).tolist() if given else []
    return share | {"largest_error_deg": max((row["error_deg"] for row in given), default=0.0), "levels_deg": middle}


def degraded(layout: Layout, instants: Sequence[Instant]) -> Iterator[Row]:
    """Yield what is left with all antennas, and with three and with two of them: sigmas, and errors against all four in their sigmas.

    An optimal estimate of a part differs from that of the whole by the difference of their covariances.
    """
    for count in (4, 3, 2):
        rows = [row for instant in instants for row in _less(layout, instant, count)]
        sigma, off, ok = (np.array([row[name] for row in rows]) for name in ("sigma_deg", "off", "ok"))
        about = {"antennas": count, "fits": len(rows), "sigma_deg": sigma.mean(axis=0).tolist()}
        yield about | {"nees": float(off.mean()), "nees_median": float(np.median(off)), "ok_pct": 100.0 * float(ok.mean())}


def _less(layout: Layout, instant: Instant, count: int) -> Iterator[Row]:
    whole = fit(layout, instant.measured)
    for kept in combinations(range(len(ANTENNAS)), count):
        measured = instant.measured
        for antenna in set(range(len(ANTENNAS))) - set(kept):
            measured = measured.without(antenna)
        verdict = judged(layout, measured, start=whole.ned_from_body if whole else None)
        if whole is not None and verdict.fit is not None and (count > 2 or not _diagonal(kept)):
            yield {"sigma_deg": _sigmas_deg(verdict.fit), "off": _nees(verdict.fit, whole), "ok": verdict.finding is Finding.OK}


def _diagonal(kept: tuple[int, ...]) -> bool:
    return (kept[1] - kept[0]) % 2 == 0


def _sigmas_deg(found: Fit) -> list[float]:
    """Return the sigmas of the smallest and of the largest seen rotation."""
    values = np.linalg.eigvalsh(found.cov[:3, :3])
    seen = values[values > 1e-9 * values[-1]]
    return np.degrees(np.sqrt([seen[0], seen[-1]])).tolist()


def _nees(part: Fit, whole: Fit) -> float:
    """Return the squared error of a part of the antennas against all, per seen axis."""
    if part.degrees == whole.degrees:
        return 0.0
    values, vectors = np.linalg.eigh(part.cov[:3, :3])
    basis = vectors[:, values > 1e-9 * values[-1]]
    gained, axes = np.linalg.eigh(basis.T @ (part.cov[:3, :3] - whole.cov[:3, :3]) @ basis)
    told = gained > _SAME * gained[-1]  # the lost antenna of four in a plane told of one tilt only
    error = (basis @ axes[:, told]).T @ seen_error(part, whole)
    return float(np.mean(np.square(error) / gained[told]))


# --- the page ---


def measured(folder: Path, *, quick: bool = False) -> Row:
    """Return all figures."""
    recording = read(folder)
    found = calibrate(ANTENNAS, [i for i in recording.instants if antennas_of(i) >= 2])
    instants = [scaled(i, found) for i in recording.instants]
    alike = shared(recording)
    ours = verdicts(found.layout, instants)
    clean = [i for i in instants if antennas_of(i) == 4 and ours[round(i.time_s)].finding is Finding.OK]
    some, rng = clean[:: 10 if quick else 3], np.random.default_rng(2022)
    return {
        "calibration": _calibration(found),
        "distances": [row_of(row) for row in found.distances],
        "availability": availability(ours, recording),
        "against": {
            "author, all": against(ours, recording.author),
            "author, four antennas": against(only(ours, recording, 4), recording.author),
            "author, three antennas": against(only(ours, recording, 3), recording.author),
            "inertial system, all": against(ours, recording.inertial),
            "inertial system, after its first minute": against(ours, recording.inertial[_ALIGNING_S:]),
        },
        "shared": alike | positions(found.layout, clean, np.array(alike["correlation"])),
        "smallest_mm": smallest_mm(found.layout, clean),
        "faults": [row for lost in (0, 1, 2) for row in faults(found.layout, some, lost, rng)],
        "degraded": list(degraded(found.layout, some)),
    }


def _calibration(found: Calibration) -> Row:
    names = ("instants", "used", "reduced", "wrong_distance", "wrong_chi_square", "scale_horizontal", "scale_vertical", "variance_factor")
    shape = {"thickness_mm": 1e3 * found.thickness_m, "thickness_sigma_mm": 1e3 * found.thickness_sigma_m}
    places = {"positions_m": found.layout.positions_m.tolist(), "sigmas_mm": (1e3 * found.sigmas_m).tolist()}
    return {name: getattr(found, name) for name in names} | shape | places


def row_of(row: Any) -> Row:
    about = {"names": "-".join(row.names), "mean_m": row.mean_m, "sd_mm": 1e3 * row.sd_m}
    return about | {"within_pct": row.within_pct, "alike_s": row.correlation_s}


def availability(ours: dict[int, Judged], recording: Recording) -> Row:
    """Return how many epochs of three antennas or more have an attitude, and what was found of them."""
    counts = Counter(verdict.finding.value for verdict in ours.values())
    fitted = sum(verdict.fit is not None for verdict in ours.values())
    antennas = Counter(antennas_of(i) for i in recording.instants)
    shares = {"fitted_pct": 100.0 * fitted / len(ours), "ok_pct": 100.0 * (counts["ok"] + counts["excluded"]) / len(ours)}
    return {"epochs": len(ours), **shares, "findings": dict(counts), "antennas": dict(sorted(antennas.items()))}


def positions(layout: Layout, instants: Sequence[Instant], correlation: Vector) -> Row:
    """Return the sigmas (mm: north, down) of the centroid and of heading (deg), with and without what the positions share."""
    centre, rows = layout.positions_m.mean(axis=0), list[list[float]]()
    for instant in instants[::10]:
        pair = fit(layout, instant.measured), fit(layout, with_shared(instant, np.clip(correlation, 0.0, 0.95)).measured)
        if pair[0] is None or pair[1] is None:
            continue
        at = [1e3 * np.sqrt(np.diag(one.point(centre)[1]))[[0, 2]] for one in pair if one is not None]
        rows.append([*at[0], *at[1], *(float(np.degrees(np.sqrt(one.angles_cov_rad2[0, 0]))) for one in pair if one is not None)])
    north, down, north_shared, down_shared, heading, heading_shared = np.mean(rows, axis=0).tolist()
    return {"centroid": [north, down], "centroid_shared": [north_shared, down_shared], "heading_deg": [heading, heading_shared]}


def smallest_mm(layout: Layout, instants: Sequence[Instant]) -> list[float]:
    """Return the smallest faults (horizontal, vertical; the worst antenna) that the mean sigmas let be found nine times in ten."""
    variances = np.mean([np.diag(i.measured.cov_m2).reshape(-1, 3).mean(axis=0) for i in instants], axis=0)
    faults_m = design(layout, Noise(float(np.sqrt(variances[0])), float(np.sqrt(variances[2]))), np.zeros(3)).detectable.values()
    return [1e3 * max(max(f.forward_m, f.right_m) for f in faults_m), 1e3 * max(f.down_m for f in faults_m)]


def page(found: Row) -> str:
    """Return the tables as Markdown."""
    parts = [_layout_table(found), _distance_table(found), _comparison(found), _sentence(found), _fault_table(found), _loss_table(found)]
    return "\n".join(parts)


def _layout_table(found: Row) -> str:
    rows = zip(ANTENNAS, found["calibration"]["positions_m"], found["calibration"]["sigmas_mm"], strict=True)
    cells = [[name, *(f"{v:.4f}" for v in place), " / ".join(f"{v:.1f}" for v in sigma)] for name, place, sigma in rows]
    return table(("antenna", "forward m", "right m", "down m", "sigmas mm"), cells)


def _distance_table(found: Row) -> str:
    cells = [
        [row["names"], f"{row['mean_m']:.4f}", f"{row['sd_mm']:.1f}", f"{row['within_pct']:.1f}", f"{row['alike_s']:.0f}"]
        for row in found["distances"]
    ]
    return table(("antennas", "distance m", "sd mm", "within 5 cm %", "errors alike for s"), cells)


def _comparison(found: Row) -> str:
    heads = ("epochs", "time offset s", "frames", "rms before", "rms after", "median after", "within 3 deg %")
    rows = [[name, *(str(row[head]) for head in heads)] for name, row in found["against"].items()]
    return table(("heading / pitch / roll against", *heads), rows)


def _sentence(found: Row) -> str:
    there, at, alike = found["availability"], found["calibration"], found["shared"]
    findings = ", ".join(f"{name} {count}" for name, count in there["findings"].items())
    rows = [
        ["epochs with three antennas or more; with an attitude", f"{there['epochs']}; {there['fitted_pct']:.1f} %"],
        ["of these with integrity ok", f"{there['ok_pct']:.1f} %"],
        ["verdicts", findings],
        [
            "calibration: instants used; left out by distances, by chi-square",
            f"{at['used']}; {at['wrong_distance']}, {at['wrong_chi_square']}",
        ],
        ["true by told sigmas, horizontal and vertical", f"{at['scale_horizontal']:.2f}, {at['scale_vertical']:.2f}"],
        ["off the best plane, with sigma", f"{at['thickness_mm']:.1f}, {at['thickness_sigma_mm']:.1f} mm"],
        [
            f"errors of two receivers alike while standing ({alike['stretches']} stretch, {alike['seconds']} s), N / E / D",
            " / ".join(f"{v:.2f}" for v in alike["correlation"]),
        ],
        ["their standard deviations, N / E / D", " / ".join(f"{v:.1f}" for v in alike["sd"]) + " mm"],
        [
            "smallest faults found nine times in ten, horizontal, vertical",
            f"{found['smallest_mm'][0]:.0f}, {found['smallest_mm'][1]:.0f} mm",
        ],
        ["sigma of the centroid N / D: independent", " / ".join(f"{v:.1f}" for v in alike["centroid"]) + " mm"],
        ["the same with what they share", " / ".join(f"{v:.1f}" for v in alike["centroid_shared"]) + " mm"],
        ["sigma of heading: independent, and with what they share", ", ".join(f"{v:.3f}" for v in alike["heading_deg"]) + " deg"],
    ]
    return table(("what", "figure"), rows)


def _fault_table(found: Row) -> str:
    cells = [
        [
            str(row["lost"]),
            row["direction"],
            f"{1e3 * row['size_m']:.0f}",
            *(f"{row[n]:.1f}" for n in _SHARES),
            f"{row['largest_error_deg']:.2f}",
            " / ".join("" if np.isnan(value) else f"{value:.1f}" for value in row["levels_deg"]),
        ]
        for row in found["faults"]
    ]
    heads = (
        "found %",
        "right one %",
        "wrong one %",
        "attitude given %",
        "outside its sigmas %",
        "outside its level %",
        "largest error given deg",
        "levels deg",
    )
    return table(("lost", "fault", "mm", *heads), cells)


def _loss_table(found: Row) -> str:
    cells = [
        [
            str(r["antennas"]),
            str(r["fits"]),
            " / ".join(f"{v:.2f}" for v in r["sigma_deg"]),
            f"{r['nees']:.2f}, {r['nees_median']:.2f}",
            f"{r['ok_pct']:.1f}",
        ]
        for r in found["degraded"]
    ]
    return table(
        ("antennas left", "fits", "sigma of best / worst seen axis deg", "squared error by covariance: mean, median", "judged ok %"), cells
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--quick", action="store_true", help="faults in every tenth epoch, not every third")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    options = parser.parse_args()
    data = options.data or data_folder()
    if data is None:
        print("four_antennas: no recordings: set RTKMESH_DATA or give --data", file=sys.stderr)
        return 2
    found = measured(data / FOLDER, quick=options.quick)
    print(json.dumps(found, indent=1) if options.json else page(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
