"""Receivers that take commands as text: Unicore N4 (``$command,...,response: OK``) and Septentrio (``$R: ...``).

Unicore N4 commands manual R1.4, 3 (MODE) and 4 (CONFIG); its command replies have checksums that firmware makes in different ways, so
they are judged by their words. Septentrio mosaic-X5 reference guide, 3.1 (replies), setPVTMode, setStaticPosGeodetic.
"""

from math import degrees
from typing import Final

import numpy as np

from rtkmesh.gnss.frames import geodetic_from_ecef
from rtkmesh.gnss.receiver import SurveyIn
from rtkmesh_services.ingest.receivers.orders import Answer, Heard, Order
from rtkmesh_services.ingest.receivers.survey import Dialect, Position
from rtkmesh_services.ingest.receivers.ublox import Ublox, UbloxLegacy

LONGEST_SURVEY_S: Final = 3600  # MODE BASE TIME takes no more
SEPTENTRIO_WAKE: Final = b"SSSSSSSSSS\r\n"  # takes a port that is set to RTCM input back to commands


def squeezed(text: str) -> str:
    """Return a text in small letters without blanks: how answers are compared."""
    return "".join(text.lower().split())


def unicore(command: str) -> Order:
    """Return the order of a Unicore command: taken with ``response: OK``."""
    wanted = squeezed(command)

    def judge(heard: Heard) -> Answer | None:
        if not isinstance(heard, str) or "response:" not in heard:
            return None
        said = squeezed(heard[heard.find("$command") :])
        if wanted not in said:
            return None
        verdict = heard.rpartition("response:")[2].partition("*")[0].strip()
        if verdict == "OK":
            return Answer(accepted=True, text="OK") if said.startswith(f"$command,{wanted},") else None
        return Answer(accepted=False, text=verdict)

    return Order(command, f"{command}\r\n".encode("ascii", "replace"), judge)


def septentrio(command: str) -> Order:
    """Return the order of a Septentrio command: ``$R: NAME`` takes it, ``$R? NAME`` refuses it."""
    wanted = squeezed(command)
    name = command.replace(",", " ").split()[0].lower()

    def judge(heard: Heard) -> Answer | None:
        if not isinstance(heard, str):
            return None
        _, found, said = heard.rpartition("$R")
        if not found or name not in said.lower():
            return None
        if said[:1] in (":", ";"):
            return Answer(accepted=True, text=said[1:].strip()) if squeezed(said[1:]).startswith(wanted) else None
        return Answer(accepted=False, text=said[1:].strip())

    return Order(command, f"{command}\r\n".encode("ascii", "replace"), judge)


class _OfFewWords:
    """A receiver that does not say how its survey goes: its 1005/1006 ends it."""

    tells_progress = False

    def ask(self) -> list[Order]:
        """Nothing can be asked."""
        return []

    def progress(self, heard: Heard) -> SurveyIn | None:
        """Nothing is said."""
        del heard


class Unicore(_OfFewWords):
    """UM980, UM982 and their relatives. A survey lasts its time; the receiver says neither its progress nor its accuracy."""

    name = "unicore"

    def survey(self, minimum_s: float, accuracy_m: float) -> list[Order]:
        """Return the orders of a new survey."""
        del accuracy_m
        return [unicore(f"MODE BASE TIME {min(LONGEST_SURVEY_S, round(minimum_s))}")]

    def fixed(self, position_ecef_m: Position, accuracy_m: float) -> list[Order]:
        """Return the orders that tell the position: as ECEF, because heights are above mean sea level."""
        del accuracy_m
        x_m, y_m, z_m = position_ecef_m
        return [unicore(f"MODE BASE {x_m:.4f} {y_m:.4f} {z_m:.4f}")]

    def rover(self) -> list[Order]:
        """Return the orders that make it a rover again."""
        return [unicore("MODE ROVER")]


class Septentrio(_OfFewWords):
    """mosaic, AsteRx. It averages until it finds its position good enough, and takes no limits."""

    name = "septentrio"

    def survey(self, minimum_s: float, accuracy_m: float) -> list[Order]:
        """Return the orders of a new survey: from rover to static, or nothing begins anew."""
        del minimum_s, accuracy_m
        return [*self.rover(), septentrio("setPVTMode, Static, , auto")]

    def fixed(self, position_ecef_m: Position, accuracy_m: float) -> list[Order]:
        """Return the orders that tell the position."""
        del accuracy_m
        lat_rad, lon_rad, height_m = geodetic_from_ecef(np.array(position_ecef_m)).tolist()
        place = f"{degrees(lat_rad):.9f}, {degrees(lon_rad):.9f}, {height_m:.4f}"
        return [septentrio(f"setStaticPosGeodetic, Geodetic1, {place}"), septentrio("setPVTMode, Static, , Geodetic1")]

    def rover(self) -> list[Order]:
        """Return the orders that make it a rover again."""
        return [septentrio("setPVTMode, Rover")]


def dialect_of(receiver: str) -> Dialect | None:
    """Return the language of a kind of receiver, None for one that we speak none with."""
    made: dict[str, type[Dialect]] = {"ublox": Ublox, "ublox-legacy": UbloxLegacy, "unicore": Unicore, "septentrio": Septentrio}
    kind = made.get(receiver)
    return None if kind is None else kind()
