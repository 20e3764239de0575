"""What goes wrong with single satellites without anybody telling: steps and ramps of codes, slips of phases, orbits that are off."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.simulation.sky import absolute_s


@dataclass(frozen=True, slots=True)
class Disturbance:
    """An error of one satellite, on one signal or on all of them (None), from ``start_s`` to ``end_s`` (s from the sky's REFERENCE)."""

    satellite: int
    signal: int | None
    start_s: float
    end_s: float = inf
    code_m: float = 0.0
    code_rate_mps: float = 0.0
    phase_cyc: float = 0.0


def disturbed(epoch: Epoch, disturbances: Sequence[Disturbance]) -> Epoch:
    """Return the epoch with all disturbances that hold at its time; flags and lock times say nothing of them."""
    now_s = absolute_s(epoch.time)
    holding = [d for d in disturbances if d.start_s <= now_s < d.end_s]
    if not holding:
        return epoch
    code, phase = epoch.pseudorange_m.copy(), epoch.phase_cyc.copy()
    for d in holding:
        rows = (epoch.satellite == d.satellite) & ((epoch.signal == d.signal) if d.signal is not None else np.True_)
        code[rows] += d.code_m + d.code_rate_mps * (now_s - d.start_s)
        phase[rows] += d.phase_cyc
    return replace(epoch, pseudorange_m=code, phase_cyc=phase)


def with_orbit_error(ephemeris: Ephemeris, seed: int) -> Ephemeris:
    """Return an ephemeris about as wrong as real broadcast ones: 1 m along the orbit and across it (GLONASS 1.5 m in every direction).

    Our choice; the errors in range, clocks included, are 0.7 m (GPS) to 1.9 m (GLONASS) (Montenbruck, Steigenberger and Hauschild 2015,
    GPS Solut 19:321-333). The error belongs to satellite and seed, whatever the issue; clocks cancel between receivers and are left alone.
    """
    along, across, out = np.random.default_rng((seed, ephemeris.satellite, 7004)).standard_normal(3).tolist()
    if isinstance(ephemeris, GlonassEphemeris):
        x, y, z = ephemeris.position_m
        return replace(ephemeris, position_m=(x + 1.5 * along, y + 1.5 * across, z + 1.5 * out))
    radius_m = ephemeris.sqrt_a**2
    return replace(ephemeris, m0_rad=ephemeris.m0_rad + along / radius_m, omega0_rad=ephemeris.omega0_rad + across / radius_m)


def with_wrong_orbit(ephemeris: Ephemeris, along_m: float) -> Ephemeris:
    """Return an ephemeris whose satellite is so far ahead on its orbit, as after a manoeuvre that it does not know of."""
    if isinstance(ephemeris, GlonassEphemeris):
        x, y, z = (
            np.array(ephemeris.position_m) + along_m * np.array(ephemeris.velocity_mps) / np.linalg.norm(ephemeris.velocity_mps)
        ).tolist()
        return replace(ephemeris, position_m=(x, y, z))
    return replace(ephemeris, m0_rad=ephemeris.m0_rad + along_m / ephemeris.sqrt_a**2)
