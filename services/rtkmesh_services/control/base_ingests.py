"""The process of a preset: an ingest that is in no file, made of the preset's table."""

from typing import Final

import msgspec

from rtkmesh_schemas.config import BaseStationTable, CommandsTable, Deployment, IngestTable
from rtkmesh_schemas.config_presets import BasesTable
from rtkmesh_schemas.keys import Role
from rtkmesh_schemas.presets import Preset, ingest_id
from rtkmesh_services.control.fleet import LaunchOptions, ProcessSpec, spec_for
from rtkmesh_services.runtime.extra_ingest import ingest_environment

_OBSERVATIONS: Final = {"auto": "auto", "rtcm2": "auto", "rtcm3": "rtcm3", "ubx": "ubx"}
_SURVEY_FORMATS: Final = ("auto", "ubx")
_SURVEYED: Final = ("serial", "tcp", "tcp-listen")


def ingest_table(preset: Preset, bases: BasesTable) -> IngestTable:
    """Return the table of the ingest that reads a preset's stream.

    With ``auto_survey`` its receiver is asked for its position, unless that is known; without it only when somebody asks for a survey.
    """
    table = preset.table
    known = table.position_ecef_m is not None or table.position_llh_deg is not None
    takes_orders = preset.format in _SURVEY_FORMATS and not known and preset.sources[0].partition("://")[0] in _SURVEYED
    return msgspec.convert(
        {
            "source": preset.sources[0],
            "fallback": preset.sources[1:],
            "position_ecef_m": table.position_ecef_m,
            "position_llh_deg": table.position_llh_deg,
            "observations": _OBSERVATIONS[preset.format],
            "filter": table.filter,
            "commands": CommandsTable(start=table.init),
            "base_station": survey_of(preset, bases) if takes_orders else None,
        },
        IngestTable,
    )


def survey_of(preset: Preset, bases: BasesTable) -> BaseStationTable:
    """Return how the receiver of a preset is asked for its position; one whose language nobody speaks is averaged."""
    receiver = preset.table.receiver
    mode = "watch" if not preset.auto_survey else "average" if receiver == "other" else "survey-in"
    return BaseStationTable(mode=mode, receiver=receiver, minimum_s=bases.survey_s, accuracy_m=bases.survey_accuracy_m)


def base_spec(preset: Preset, deployment: Deployment, options: LaunchOptions) -> ProcessSpec:
    """Return the process of a preset."""
    table = ingest_table(preset, deployment.bases)
    tables = msgspec.json.encode([deployment.deployment, deployment.hub, table])
    return spec_for(ingest_id(preset.id), Role.INGEST, options, tables, ingest_environment(table))
