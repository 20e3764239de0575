"""RTCM 3 messages that are known and not used: their names, for the counters (RTCM 10403.3, 3.5; IGS SSR 1.00, table 2)."""

from typing import Final

_SSR: Final = ("orbits", "clocks", "code biases", "orbits and clocks", "URA", "high-rate clocks")
_SYSTEMS: Final = ((1057, "GPS"), (1063, "GLONASS"), (1240, "Galileo"), (1246, "QZSS"), (1252, "SBAS"), (1258, "BeiDou"))


def _names() -> dict[int, str]:
    """Return the names by number."""
    names = {first + k: f"SSR {system} {what}" for first, system in _SYSTEMS for k, what in enumerate(_SSR)}
    names |= {1264: "SSR ionosphere", 4076: "IGS SSR"}
    names |= {1265 + k: f"SSR {system} phase biases" for k, (_, system) in enumerate(_SYSTEMS)}
    names |= dict.fromkeys((1001, 1003, 1009, 1011), "without the modulus of the pseudorange")
    names |= {1013: "system parameters", 1029: "text", 1030: "network residuals GPS", 1031: "network residuals GLONASS"}
    names |= {
        1032: "physical reference station",
        1014: "network auxiliary station",
        4072: "u-blox reference station",
        1041: "NavIC ephemeris",
    }
    names |= dict.fromkeys((1015, 1016, 1017, 1034, 1035, 1037, 1038, 1039), "network corrections")
    names |= dict.fromkeys(range(1021, 1028), "transformation")
    compact = {group + level: "compact MSM" for group in (1070, 1080, 1090, 1100, 1110, 1120, 1130) for level in (1, 2, 3)}
    return names | compact


_NAMES: Final = _names()


def known_name(number: int) -> str:
    """Return ``(what it is, not used)`` of a known message, nothing of one that is not known."""
    name = _NAMES.get(number)
    return f"({name}, not used)" if name else ""
