"""What gathers the faults of a deployment file."""

from typing import Protocol


class Faults(Protocol):
    """What gathers the faults of one file."""

    def fault(self, path: tuple[str, ...], message: str) -> None:
        """Gather one fault at a key (or at the nearest table above it)."""
        ...

    def names_of(self, role: str) -> list[str]:
        """Return the ids of a role, also of tables that have faults of their own."""
        ...
