"""Ephemerides, ionosphere and reference stations to and from the wire."""

from dataclasses import fields
from typing import Any

from rtkmesh.gnss.ephemeris import (
    Ephemeris,
    GlonassBias,
    GlonassEphemeris,
    KeplerEphemeris,
    KlobucharParameters,
    NavigationMessage,
    ReferenceStation,
)
from rtkmesh.gnss.signals import satellite_id, satellite_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_schemas.observation import EphemerisMessage, GlonassState, IonosphereMessage, KeplerOrbit, ReferenceMessage, Time

_KEPLER = tuple(field.name for field in fields(KeplerEphemeris))
_GLONASS = tuple(field.name for field in fields(GlonassEphemeris))


def time_of(time: Time | None) -> GpsTime | None:
    """Return a wire time as the engine's, or None."""
    return None if time is None else GpsTime(time[0], time[1])


def wire_time(time: GpsTime | None) -> Time | None:
    """Return an engine time as the wire's, or None."""
    return None if time is None else (time.week, time.tow_s)


def orbit_of(ephemeris: Ephemeris) -> KeplerOrbit | GlonassState:
    """Return an ephemeris as the wire's struct."""
    names = _KEPLER if isinstance(ephemeris, KeplerEphemeris) else _GLONASS
    values: dict[str, Any] = {name: _to_wire(getattr(ephemeris, name)) for name in names}
    values["satellite"] = satellite_id(ephemeris.satellite)
    return KeplerOrbit(**values) if isinstance(ephemeris, KeplerEphemeris) else GlonassState(**values)


def ephemeris_of(message: EphemerisMessage) -> Ephemeris:
    """Return the ephemeris of a message; DecodeError for values that no ephemeris has."""
    orbit = message.orbit
    names = _KEPLER if isinstance(orbit, KeplerOrbit) else _GLONASS
    values: dict[str, Any] = {name: getattr(orbit, name) for name in names}
    try:
        values["satellite"] = satellite_number(orbit.satellite)
        for name in ("toe", "toc", "transmitted"):
            if name in values:
                values[name] = GpsTime(*values[name])
        if isinstance(orbit, KeplerOrbit):
            values["message"] = NavigationMessage(orbit.message)
            return KeplerEphemeris(**values)
        return GlonassEphemeris(**values)
    except ValueError as error:
        raise DecodeError(f"ephemeris of {message.source}: {error}") from error


def klobuchar_of(message: IonosphereMessage) -> KlobucharParameters:
    """Return the ionosphere coefficients of a message."""
    return KlobucharParameters(message.system, message.alpha, message.beta)


def station_of(message: ReferenceMessage) -> ReferenceStation:
    """Return the reference station of a message."""
    return ReferenceStation(
        station_id=message.station_id,
        position_ecef_m=message.position_ecef_m,
        antenna_height_m=message.antenna_height_m,
        antenna=message.antenna,
        antenna_serial=message.antenna_serial,
        receiver=message.receiver,
        source=message.origin,
    )


def glonass_bias_of(message: ReferenceMessage) -> GlonassBias | None:
    """Return the GLONASS code-phase biases of a reference message, or None when it has none."""
    if message.glonass_bias_m is None:
        return None
    return GlonassBias(message.station_id, aligned=True, bias_m=message.glonass_bias_m)


def _to_wire(value: Any) -> Any:
    if isinstance(value, GpsTime):
        return (value.week, value.tow_s)
    return int(value) if isinstance(value, NavigationMessage) else value
