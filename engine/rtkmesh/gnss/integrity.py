"""One vocabulary for whether a solution may be used: positions, baselines and attitudes say the same words."""

from enum import StrEnum


class Integrity(StrEnum):
    """Whether a solution may be used: its tests passed, one of them failed, or it cannot be told (or not well enough)."""

    OK = "ok"
    FAILED = "failed"
    UNAVAILABLE = "unavailable"
