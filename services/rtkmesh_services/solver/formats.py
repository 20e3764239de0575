"""RTKRCV's text formats of a solution, published only when somebody listens; the header goes along as attachment."""

from typing import Final

from rtkmesh.rtk.solution import Solution
from rtkmesh_schemas.keys import SOL_TEXT
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.mapping.solution import satellites_message
from rtkmesh_services.runtime.bus import Bus
from rtkmesh_services.texts import TextAbout, TextOptions, TextWriter

_OPTIONS: Final = (
    *(TextOptions(format=name, line_end="lf") for name in ("llh", "xyz", "enu", "vel_enu", "nmea")),
    TextOptions(format="stat", status="residual"),
)
_OF_SATELLITES: Final = ("nmea", "stat")


class TextPublisher:
    """The formats of one solver. Outputs have options of their own and write by themselves."""

    def __init__(self) -> None:
        self._writers = {options.format: TextWriter(options) for options in _OPTIONS}
        self._headers = {name: writer.header(TextAbout("rtkmesh")) for name, writer in self._writers.items()}

    def publish(self, bus: Bus, solution: Solution, message: SolutionMessage) -> None:
        """Publish an epoch in each format that is listened to and has something to say; ``message`` is the solution's."""
        for name, writer in self._writers.items():
            if not bus.matched(SOL_TEXT, format=name):
                continue
            satellites = satellites_message(solution, message.source) if name in _OF_SATELLITES else None
            if text := writer.text(message, satellites):
                bus.publish(SOL_TEXT, text, attachment=self._headers[name] or None, format=name)
