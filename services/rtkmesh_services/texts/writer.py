"""One output's writer: solutions in, bytes out."""

from collections.abc import Mapping
from typing import Any

from rtkmesh_schemas.solution import SatellitesMessage, SolutionMessage
from rtkmesh_services.texts.header import TextAbout, header
from rtkmesh_services.texts.lines import line
from rtkmesh_services.texts.marks import mark
from rtkmesh_services.texts.options import TextOptions


class TextWriter:
    """Writes the solutions of one solver in one format."""

    def __init__(self, options: TextOptions) -> None:
        self.options = options
        self._end = options.newline

    def header(self, about: TextAbout) -> bytes:
        """Return what stands before the first solution; nothing for nmea and stat."""
        return header(about, self.options).encode("ascii", "replace")

    def epoch(self, solution: SolutionMessage, satellites: SatellitesMessage | None = None) -> bytes:
        """Return what RTKLIB prints of an epoch; nothing where it prints nothing. ``satellites``: the newest there are."""
        del satellites
        text = line(solution, self.options)
        return (text + self._end).encode() if text else b""

    def mark(self, data: Mapping[str, Any]) -> bytes:
        """Return the line of a mark: ``data`` is that of the solver's event of code ``mark``."""
        return mark(data, self.options).encode("ascii", "replace")
