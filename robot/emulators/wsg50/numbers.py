"""Numbers of the emulated WSG-50: states, statuses, bits, limits, lengths of commands. Written from the facts, not from
the driver's."""

IDLE, GRASPING, NO_PART, PART_LOST, HOLDING, RELEASING, POSITIONING, ERROR = range(8)
OK, NOT_AVAILABLE, NOT_INITIALIZED, RUNNING, DAMAGED, NO_PARAM, FEW_PARAMS, UNKNOWN = 0, 1, 3, 4, 11, 12, 13, 14
FORMAT, DENIED, FAILED, ABORTED, INVALID, PENDING, RANGE, BLOCKED = 15, 16, 18, 19, 24, 26, 28, 29
FAULT_BITS = {
    "temperature warning": 13,
    "temperature": 14,
    "power": 15,
    "current": 16,
    "finger": 17,
    "command": 18,
    "script": 20,
}
UPDATES = frozenset({0x40, 0x41, 0x43, 0x44, 0x45})
REFERENCED_BIT, MOVING_BIT, MINUS_BIT, PLUS_BIT = 0, 1, 2, 3
STOPPED_BIT, REACHED_BIT, FORCE_BIT, FAST_STOP_BIT = 6, 7, 9, 12
SPEEDS, ACCELERATIONS, FORCES, OVERDRIVE_N = (5.0, 420.0), (100.0, 5000.0), (5.0, 80.0), 120.0
LENGTHS = {0x20: 1, 0x21: 9, 0x24: 3, 0x25: 8, 0x26: 8, 0x30: 4, 0x32: 4, 0x34: 8, 0x37: 1, 0x42: 1}
ANY_LENGTH = {0x06, 0x51}
