"""Attitude from antenna baselines: angles with full covariances, rigid bodies, integrity."""
