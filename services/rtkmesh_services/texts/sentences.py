"""The frame of NMEA sentences."""


def sentence(body: str) -> str:
    """Return a sentence with its frame: ``$``, checksum, line end (NMEA 0183 4.11, 5.3)."""
    check = 0
    for byte in body.encode("ascii", "replace"):
        check ^= byte
    return f"${body}*{check:02X}\r\n"
