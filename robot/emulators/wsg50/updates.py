"""Values that an emulated WSG-50 sends by itself, each with its own period. No I/O."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass
class _Order:
    only_changes: bool
    period_s: float
    next_s: float
    last: bytes


class Updates:
    """What is to be sent, and when. value: gives the value of a command now. Times in s of the emulator's clock."""

    def __init__(self, value: Callable[[int], bytes]) -> None:
        self._value, self._orders = value, dict[int, _Order]()

    def clear(self) -> None:
        """End them all."""
        self._orders.clear()

    def order(self, command: int, payload: bytes, now_s: float) -> bool:
        """Begin or end what flags u8 and period u16 (ms) ask for; False for a period of 0."""
        flags, period_s = payload[0], (payload[1] | payload[2] << 8) / 1000
        self._orders.pop(command, None)
        if flags & 1 and period_s:
            self._orders[command] = _Order(bool(flags & 2), period_s, now_s + period_s, self._value(command))
        return not flags & 1 or period_s > 0

    def due(self, now_s: float) -> Iterator[tuple[int, bytes]]:
        """Commands and values to be sent now."""
        for command, order in self._orders.items():
            if now_s < order.next_s:
                continue
            order.next_s = max(order.next_s + order.period_s, now_s)
            value = self._value(command)
            if not order.only_changes or value != order.last:
                yield command, value
            order.last = value
