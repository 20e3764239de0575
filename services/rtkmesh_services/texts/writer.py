"""One output's writer: solutions in, bytes out."""

from collections.abc import Mapping
from typing import Any, Final

from rtkmesh_schemas.solution import SatellitesMessage, SolutionMessage
from rtkmesh_services.texts.geodesy import known
from rtkmesh_services.texts.header import TextAbout, header
from rtkmesh_services.texts.lines import line
from rtkmesh_services.texts.marks import mark
from rtkmesh_services.texts.nmea import Course, fix_of, gga, gst, rmc
from rtkmesh_services.texts.nmea_satellites import gsa, gsv
from rtkmesh_services.texts.options import TextOptions
from rtkmesh_services.texts.sky import Dops, dops, satellites_of
from rtkmesh_services.texts.status import status
from rtkmesh_services.texts.times import is_due

_TOLERANCE_S: Final = {"demo5": 0.025, "2.4": 0.005}  # RTKLIB's DTTOL: how far off a multiple of an interval an epoch may be


class TextWriter:
    """Writes the solutions of one solver in one format."""

    def __init__(self, options: TextOptions) -> None:
        self.options = options
        self._end = options.newline
        self._course = Course()
        self._satellites_at = (0, 0.0)

    def header(self, about: TextAbout) -> bytes:
        """Return what stands before the first solution; nothing for nmea and stat."""
        return header(about, self.options).encode("ascii", "replace")

    def epoch(self, solution: SolutionMessage, satellites: SatellitesMessage | None = None) -> bytes:
        """Return what RTKLIB prints of an epoch; nothing where it prints nothing.

        ``satellites`` are the newest there are. Sentences take them as they are; status records write each message once, with its own time,
        and none of a later epoch.
        """
        return self.text(solution, satellites).encode("ascii", "replace")

    def text(self, solution: SolutionMessage, satellites: SatellitesMessage | None = None) -> str:
        """Return the same as text."""
        if self.options.format == "nmea":
            return self._sentences(solution, satellites)
        if self.options.format == "stat":
            return status(solution, self._fresh(solution, satellites), self.options)
        text = line(solution, self.options)
        return text + self._end if text else ""

    def mark(self, data: Mapping[str, Any]) -> bytes:
        """Return the line of a mark: ``data`` is that of the solver's event of code ``mark``."""
        return mark(data, self.options).encode("ascii", "replace")

    def _sentences(self, solution: SolutionMessage, satellites: SatellitesMessage | None) -> str:
        text, solved = "", solution.status > 0 and known(solution.position_ecef_m)
        if solved and self._is_due(solution, self.options.interval_s):
            text += self._position(solution, satellites)
        if satellites is not None and self._is_due(solution, self.options.satellites_interval_s):
            sky = satellites_of(satellites)
            text += gsa(sky, solved, self.options) + gsv(sky, solved, self.options)
        return text

    def _position(self, solution: SolutionMessage, satellites: SatellitesMessage | None) -> str:
        fix = fix_of(solution, self.options)
        dilutions = Dops() if fix.is_rtklibs else dops([one for one in satellites_of(satellites) if one.used])
        return rmc(fix, self._course) + gga(fix, dilutions) + ("" if fix.is_old else gst(fix))

    def _fresh(self, solution: SolutionMessage, satellites: SatellitesMessage | None) -> SatellitesMessage | None:
        """Return satellites that were not written yet and are not of a later epoch."""
        if satellites is None:
            return None
        time = satellites.week, satellites.tow_s
        if time == self._satellites_at or time > (solution.week, solution.tow_s):
            return None
        self._satellites_at = time
        return satellites

    def _is_due(self, solution: SolutionMessage, interval_s: float) -> bool:
        return is_due(solution.tow_s, interval_s, _TOLERANCE_S[self.options.dialect])
