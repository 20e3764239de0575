"""``[preset.NAME]`` and ``[bases]`` of the deployment file: base stations to choose from, and how one is chosen."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

_Coordinate = Annotated[float, Meta(ge=-1e7, le=1e7)]
PresetEcef = tuple[_Coordinate, _Coordinate, _Coordinate]
PresetGeodetic = tuple[
    Annotated[float, Meta(ge=-90.0, le=90.0)], Annotated[float, Meta(ge=-360.0, le=360.0)], Annotated[float, Meta(ge=-12000.0, le=100000.0)]
]
PresetFormat = Literal["auto", "rtcm2", "rtcm3", "ubx"]
PresetReceiver = Literal["ublox", "ublox-legacy", "unicore", "septentrio", "other"]
# ``protocol/kind`` of a frame, as a status tells it: rtcm3/1077, ubx/02-15, nmea/GNGGA.
FrameNames = Annotated[tuple[Annotated[str, Meta(pattern="^[a-z0-9]+/[A-Za-z0-9*-]{1,32}$")], ...], Meta(max_length=200)]
Lines = Annotated[tuple[Annotated[str, Meta(max_length=1000)], ...], Meta(max_length=1000)]
Sources = Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=1000)], ...], Meta(min_length=1, max_length=9)]
PresetNames = Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=64)], ...], Meta(max_length=64)]


class FilterTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[preset.NAME.filter]``: which frames of the base are used, by ``protocol/kind`` (``rtcm3/1077``).

    ``reject`` goes first; with ``accept`` only those are used. Frames that are left out are still counted.
    """

    accept: FrameNames = ()
    reject: FrameNames = ()


class PresetTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[preset.NAME]``: a base station that can be selected while everything runs.

    ``sources`` are URLs as of an ingest, the first one and those to fall back on. ``position_ecef_m`` or ``position_llh_deg`` (ellipsoidal
    height) replaces what the stream says of the antenna, ``antenna`` (IGS name) too. ``init`` are lines for the receiver, as the start
    commands of an ingest. ``auto_select``: the first such preset is selected at the first start. ``auto_survey``: a receiver on a serial
    port or TCP finds its position when it is selected (``receiver`` is its language). ``standby``: it always runs, also while another one
    is selected, so that a change to it costs no epoch.
    """

    sources: Sources
    title: Annotated[str, Meta(max_length=200)] = ""
    format: PresetFormat = "auto"
    position_ecef_m: PresetEcef | None = None
    position_llh_deg: PresetGeodetic | None = None
    antenna: Annotated[str, Meta(max_length=40)] = ""
    filter: FilterTable = FilterTable()
    init: Lines = ()
    auto_select: bool = False
    auto_survey: bool = False
    receiver: PresetReceiver = "ublox"
    standby: bool = False


class BasesTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[bases]``: how base stations are found and chosen.

    ``hot_plug``: serial ports that are plugged in become presets, one for each of ``bauds``; ``devices`` are further ports, as globs;
    ``exclude`` are globs on path or product name. A solver with a list of ``presets`` leaves a base that has been silent or bad
    (below ``bad_score``) for ``failover_after_s``, and comes back to a better placed one that has been good for ``return_after_s``. A base
    that delivers nothing within ``timeout_s`` of its selection is told as an event. Surveys of auto_survey take ``survey_s`` and
    ``survey_accuracy_m``.
    """

    hot_plug: bool = True
    bauds: Annotated[tuple[Annotated[int, Meta(ge=300, le=4_000_000)], ...], Meta(min_length=1, max_length=8)] = (115200,)
    devices: Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=200)], ...], Meta(max_length=32)] = ()
    exclude: Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=200)], ...], Meta(max_length=100)] = ()
    failover_after_s: Annotated[float, Meta(ge=1.0, le=3600.0)] = 3.0
    return_after_s: Annotated[float, Meta(ge=1.0, le=86400.0)] = 60.0
    bad_score: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.2
    timeout_s: Annotated[float, Meta(ge=1.0, le=600.0)] = 15.0
    survey_s: Annotated[float, Meta(ge=1.0, le=86400.0)] = 60.0
    survey_accuracy_m: Annotated[float, Meta(ge=0.001, le=100.0)] = 1.0
