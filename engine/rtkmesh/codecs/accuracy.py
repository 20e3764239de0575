"""Accuracy indices of the broadcast messages, as tables of one sigma in metres."""

from typing import Final

Table = tuple[float, ...]

NO_ACCURACY_M: Final = 500.0  # the system makes no statement (Galileo OS SIS ICD 2.1, 5.1.12: SISA 255)

# GPS, QZSS and BeiDou URA, nominal values (IS-GPS-200N 20.3.3.3.1.3, BDS-SIS-ICD-B1I-3.0 5.2.4.5); index 15 makes no statement.
URA_M: Final[Table] = (2.0, 2.8, 4.0, 5.7, 8.0, 11.3, *(2.0**index for index in range(4, 13)))
# Galileo SISA (Galileo OS SIS ICD 2.1 table 89); 126 and above make no statement.
SISA_M: Final[Table] = (
    *(index * 0.01 for index in range(50)),
    *(0.5 + index * 0.02 for index in range(25)),
    *(1.0 + index * 0.04 for index in range(25)),
    *(2.0 + index * 0.16 for index in range(26)),
)
# GLONASS-M F_T (GLONASS ICD 5.1 table 4.4); index 15 makes no statement.
GLONASS_FT_M: Final[Table] = (1.0, 2.0, 2.5, 4.0, 5.0, 7.0, 10.0, 12.0, 14.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0)


def accuracy_m(table: Table, index: int) -> float:
    """Return the accuracy that an index means."""
    return table[index] if 0 <= index < len(table) else NO_ACCURACY_M


def accuracy_index(table: Table, sigma_m: float) -> int:
    """Return the smallest index whose accuracy is not better than ``sigma_m`` (beyond the table: the one after its last)."""
    return next((index for index, value in enumerate(table) if value >= sigma_m - 1e-9), len(table))
