"""Which corrections a u-blox base sends: its place, its observations as MSM4 or MSM7 of some systems, the biases of GLONASS.

u-blox F9 HPG 1.32 interface description: 4.9.13 (CFG-MSGOUT); M8 protocol specification: 32.10.18 (CFG-MSG).
"""

from typing import Final

from rtkmesh_services.ingest.receivers.orders import Order
from rtkmesh_services.ingest.receivers.ublox import acknowledged, valset
from rtkmesh_services.ingest.ubx_commands import ubx_frame

STATION_EVERY: Final = 5  # epochs
_PORTS: Final = ("USB", "UART1")
_MSM: Final = {"G": 1070, "R": 1080, "E": 1090, "C": 1120}  # systems that these receivers send
_GLONASS_BIASES: Final = 1230
_LEGACY_IDS: Final = {
    1005: 0x05, 1074: 0x4A, 1077: 0x4D, 1084: 0x54, 1087: 0x57, 1094: 0x5E, 1097: 0x61, 1124: 0x7C, 1127: 0x7F, 1230: 0xE6,
}  # fmt: skip
MESSAGE_SETS: Final = {"msm4": 4, "msm7": 7}


def message_orders(dialect: str, message_set: str, systems: str) -> list[Order]:
    """Return the orders for a message set (msm4, msm7) and systems (letters, empty: all); none for receivers of other makers.

    One order a system: a receiver that does not have one of them refuses that alone.
    """
    if message_set not in MESSAGE_SETS or dialect not in ("ublox", "ublox-legacy"):
        return []
    groups = _rates(MESSAGE_SETS[message_set], systems)
    if dialect == "ublox":
        return [_by_keys(rates) for rates in groups]
    return [_by_message(number, rate) for rates in groups for number, rate in rates.items()]


def _rates(msm: int, systems: str) -> list[dict[int, int]]:
    """Return groups of message numbers with how many epochs lie between two of them; 0: not sent."""
    wanted = {letter: not systems or letter in systems for letter in _MSM}
    of_systems = [{first + kind: int(wanted[letter] and kind == msm) for kind in (4, 7)} for letter, first in _MSM.items()]
    return [{1005: STATION_EVERY}, *of_systems, {_GLONASS_BIASES: STATION_EVERY * wanted["R"]}]


def _by_keys(rates: dict[int, int]) -> Order:
    return _optional(valset({f"CFG-MSGOUT-RTCM_3X_TYPE{number}_{port}": rate for number, rate in rates.items() for port in _PORTS}))


def _by_message(number: int, rate: int) -> Order:
    return _optional(acknowledged("CFG-MSG", ubx_frame(f"CFG-MSG 0xf5 {_LEGACY_IDS[number]} 0 {rate} 0 {rate} 0 0")))


def _optional(order: Order) -> Order:
    return Order(order.said, order.data, order.judge, needed=False, attempts=2)
