"""Float filters in closed form, after an epoch of GPS and GLONASS."""

import numpy as np

from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.rtk.ambiguity import Candidates
from rtkmesh.rtk.state import DYNAMIC, HISTORY, SLOPE_KEYS, Filter

WAVELENGTH_M = 0.19
SLOPE_SIGMA_M = 0.03
GPS = 8
CHANNELS = np.array([-7.0, -4.0, -1.0, 2.0, 5.0])
TRUE = np.array([3, -7, 12, 0, 5, 1, -2, 9, 4, -3, 8, 2, -6])


def floating(rng, code_m=0.5, phase_m=0.003, gps=GPS, slope_m=None, channels=CHANNELS):
    """A filter after an epoch of both systems: position and clocks by codes, phases, those of GLONASS with a slope that is not known."""
    n, glonass = gps + len(channels), len(channels)
    azimuth, elevation = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(0.3, 1.5, n)
    sky = np.column_stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    channel, system = np.concatenate([np.zeros(gps), channels]), np.repeat([0, 1], [gps, glonass])
    states = DYNAMIC + 1 + n
    # Codes: position and a clock per system; phases: position, slope and ambiguity, the clock being that of the ambiguities.
    codes, phases = np.zeros((n, states + 2)), np.zeros((n, states + 2))
    codes[:, :3] = phases[:, :3] = -sky
    codes[np.arange(n), states + system] = 1.0
    phases[:, DYNAMIC], phases[np.arange(n), DYNAMIC + 1 + np.arange(n)] = channel, WAVELENGTH_M
    slope_m = SLOPE_SIGMA_M * rng.standard_normal() if slope_m is None else slope_m
    truth = np.zeros(states + 2)
    truth[DYNAMIC], truth[DYNAMIC + 1 : DYNAMIC + 1 + n] = slope_m, TRUE[:n]
    prior = np.diag(np.concatenate([np.full(3, 1e-4), np.ones(6), [SLOPE_SIGMA_M**-2], np.full(n, 1e-8), np.full(2, 1e-6)]))
    N = prior + codes.T @ codes / code_m**2 + phases.T @ phases / phase_m**2
    b = codes.T @ (codes @ truth + code_m * rng.standard_normal(n)) / code_m**2
    b += phases.T @ (phases @ truth + phase_m * rng.standard_normal(n)) / phase_m**2
    P = np.linalg.inv(N)
    keys = np.concatenate([SLOPE_KEYS[:1], (np.arange(n) + 1 + system * (64 - gps)) * KEYS_PER_SATELLITE])
    x = P @ b
    everything = Candidates(np.arange(1, n + 1), system.astype(np.int64), keys[1:] // KEYS_PER_SATELLITE, elevation)
    return Filter(x[:states].copy(), P[:states, :states].copy(), keys, np.zeros((n + 1, HISTORY))), everything
