"""Bytes to values and back: framing, UBX, RTCM 3, RINEX, NMEA, .pos. No I/O, no exceptions for damaged data."""
