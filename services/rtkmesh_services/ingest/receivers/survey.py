"""What all languages can say of a base's position, and which language is whose."""

from typing import Protocol

from rtkmesh.gnss.receiver import SurveyIn
from rtkmesh_services.ingest.receivers.orders import Heard, Order

Position = tuple[float, float, float]


class Dialect(Protocol):
    """How a base station is made of a receiver. ``tells_progress``: it says how its survey goes; else its 1005/1006 ends it."""

    name: str
    tells_progress: bool

    def survey(self, minimum_s: float, accuracy_m: float) -> list[Order]:
        """Return the orders of a new survey."""
        ...

    def fixed(self, position_ecef_m: Position, accuracy_m: float) -> list[Order]:
        """Return the orders that tell the position."""
        ...

    def rover(self) -> list[Order]:
        """Return the orders that make it a rover again."""
        ...

    def ask(self) -> list[Order]:
        """Return the orders that ask how the survey goes; none where it cannot be asked."""
        ...

    def progress(self, heard: Heard) -> SurveyIn | None:
        """Return what was said of a survey, None for anything else."""
        ...
