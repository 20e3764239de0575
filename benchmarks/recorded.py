"""The recorded pairs, solved in process by the offline solver of the services: solutions with covariances, not the digits of a .pos."""

import kernel_cache  # noqa: F401  first of all
from cases import Case
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import SessionOptions, pairing_for
from rtkmesh.rtk.solution import Solution
from rtkmesh_services.cli.offline import Run, open_inputs


def solutions(case: Case, options: RtkOptions) -> list[Solution]:
    """Return the solutions of all epochs of a case; of a moving base nobody tells the position."""
    date = GpsTime.from_calendar(*(int(part) for part in case.date.split("-")), 12) if case.date else None
    inputs = open_inputs(case.rover, case.base, case.navigation, date)
    position = None if options.mode is Mode.MOVING_BASE else case.base_ecef_m
    session = SessionOptions(options, pairing_for(options, replay=True), position, navigation_streams=len(case.navigation))
    return list(Run(inputs, session).solutions())
