"""Orbits and clocks, atmosphere, antennas, noise, single-point positioning."""
