"""Which numbers of which senders pass `order`, kept as plain integers."""

from __future__ import annotations

from dataclasses import dataclass, field

MOST_SENDERS = 64


@dataclass
class Order:
    """Numbers count modulo 2 to the power of `bits`; a sender of which none has passed for `patience` may restart."""

    bits: int
    patience: int
    _passed: dict[object, tuple[int, int]] = field(default_factory=dict)

    def passes(self, sender: object, number: int, now: int) -> bool:
        if sender in self._passed:
            last, at = self._passed[sender]
            ahead = (number - last) % (1 << self.bits)
            if now <= at + self.patience and not 0 < ahead < 1 << (self.bits - 1):
                return False
        elif len(self._passed) == MOST_SENDERS:
            del self._passed[min(self._passed, key=lambda known: self._passed[known][1])]
        self._passed[sender] = number, now
        return True
