"""Headings that receivers compute, to the wire."""

from typing import Any

from rtkmesh.gnss.receiver import ReceiverHeading
from rtkmesh_schemas.attitude import HeadingMessage
from rtkmesh_services.mapping.navigation import wire_time


def heading_message(heading: ReceiverHeading, **identity: Any) -> HeadingMessage:
    """Return a receiver's heading as the wire's struct."""
    return HeadingMessage(
        time=wire_time(heading.time),
        message=heading.source,
        valid=heading.valid,
        solution="" if heading.solution is None else heading.solution.name.lower(),
        of_baseline=heading.of_baseline,
        heading_rad=heading.heading_rad,
        heading_sigma_rad=heading.heading_sigma_rad,
        pitch_rad=heading.pitch_rad,
        pitch_sigma_rad=heading.pitch_sigma_rad,
        roll_rad=heading.roll_rad,
        roll_sigma_rad=heading.roll_sigma_rad,
        length_m=heading.length_m,
        length_sigma_m=heading.length_sigma_m,
        satellites=heading.satellites,
        **identity,
    )
