"""The frame of NMEA sentences."""


def sentence(body: str) -> str:
    """Return a sentence with its frame: ``$``, checksum, line end (NMEA 0183 4.11, 5.3). What is not ASCII is ``?``."""
    data, check = body.encode("ascii", "replace"), 0
    for byte in data:
        check ^= byte
    return f"${data.decode('ascii')}*{check:02X}\r\n"
