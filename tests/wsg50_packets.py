"""Packets of the WSG-50 as printed in its manual and in the tests of a public driver."""

MANUAL_REPLIES = {
    # meaning: (bytes, id, payload)
    "empty": ("AA AA AA 01 00 00 E8 10", 0x01, ""),
    "two bytes": ("AA AA AA 01 02 00 12 34 6D 66", 0x01, "12 34"),
    "homing done": ("AA AA AA 20 02 00 00 00 B3 FD", 0x20, "00 00"),
    "unknown command 90h": ("AA AA AA 90 02 00 0E 00 FD 02", 0x90, "0E 00"),
    "acceleration 150": ("AA AA AA 30 06 00 00 00 00 00 16 43 DC CB", 0x30, "00 00 00 00 16 43"),
    "move pending": ("AA AA AA 21 02 00 1A 00 67 CB", 0x21, "1A 00"),
    "move done": ("AA AA AA 21 02 00 00 00 28 04", 0x21, "00 00"),
}
COMMANDS = {
    "acknowledge": ("AA AA AA 24 03 00 61 63 6B DC B9", 0x24, "61 63 6B"),
    "disconnect": ("AA AA AA 07 00 00 35 4C", 0x07, ""),
    "fast stop": ("AA AA AA 23 00 00 AC 1C", 0x23, ""),
    "stop": ("AA AA AA 22 00 00 0E 76", 0x22, ""),
    "get force limit": ("AA AA AA 33 00 00 2C 70", 0x33, ""),
    "grasping state every 4E0Eh ms": ("AA AA AA 41 03 00 01 0E 4E 15 B9", 0x41, "01 0E 4E"),
    "opening every 1234h ms": ("AA AA AA 43 03 00 01 34 12 85 F3", 0x43, "01 34 12"),
    "info": ("AA AA AA 50 00 00 DB 87", 0x50, ""),
    "grasp 12 mm 34 mm/s": ("AA AA AA 25 08 00 00 00 40 41 00 00 08 42 A7 F1", 0x25, "00 00 40 41 00 00 08 42"),
    "loop abc": ("AA AA AA 06 03 00 61 62 63 CA 44", 0x06, "61 62 63"),
    "move to 34 mm at 56 mm/s, stop on block": (
        "AA AA AA 21 09 00 02 00 00 08 42 00 00 60 42 95 56",
        0x21,
        "02 00 00 08 42 00 00 60 42",
    ),
}
PACKETS = {**MANUAL_REPLIES, **COMMANDS}


def bytes_of(name):
    """Return the bytes of a packet."""
    return bytes.fromhex(PACKETS[name][0])
