"""RTKRCV's text formats of a solution, published only when somebody listens; the .pos header goes along as attachment."""

from typing import Final

from rtkmesh.codecs.pos import Coordinates, PosFormat, pos_header, pos_line
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh_schemas.keys import SOL_TEXT
from rtkmesh_services.runtime.bus import Bus

FORMATS: Final = {
    "llh": PosFormat(coordinates=Coordinates.LLH),
    "xyz": PosFormat(coordinates=Coordinates.XYZ),
    "enu": PosFormat(coordinates=Coordinates.ENU),
}
HEADERS: Final = {name: pos_header(form, "rtkmesh").encode() for name, form in FORMATS.items()}


def publish_texts(bus: Bus, solution: Solution) -> None:
    """Publish the solution as a .pos line in each format that is listened to."""
    if solution.status is Status.NONE:
        return
    for name, form in FORMATS.items():
        if bus.matched(SOL_TEXT, format=name):
            bus.publish(SOL_TEXT, pos_line(solution, form), attachment=HEADERS[name], format=name)
