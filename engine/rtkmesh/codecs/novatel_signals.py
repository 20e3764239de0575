"""Signals as NovAtel OEM4 to OEM7 receivers number them (OEM7 commands and logs reference manual v15C, RANGE: channel tracking status).

Systems and satellites have the numbers that Unicore took over.
"""

from typing import Final

from rtkmesh.codecs.unicore_signals import signal_table

# System -> {signal type: RINEX code}. BeiDou tells D1 (0 to 2) from D2 (4 to 6).
SIGNALS: Final = {
    0: {0: "1C", 5: "2P", 9: "2W", 14: "5Q", 16: "1L", 17: "2S"},
    1: {0: "1C", 1: "2C", 5: "2P", 6: "3Q"},
    2: {0: "1C", 6: "5I"},
    3: {2: "1C", 6: "6B", 7: "6C", 12: "5Q", 17: "7Q", 20: "8Q"},
    4: {0: "2I", 1: "7I", 2: "6I", 4: "2I", 5: "7I", 6: "6I", 7: "1P", 9: "5P", 11: "7D"},
    5: {0: "1C", 14: "5Q", 16: "1L", 17: "2S", 27: "6L"},
    6: {0: "5A"},
}  # fmt: skip
SIGNAL_OF = signal_table(SIGNALS)
