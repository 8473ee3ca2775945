"""Hold the active faults of an arm in memory until a person acknowledges each by its code.

The state machine refuses to arm the arm while there are any (`states.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

from ident_service.errors import UsageError


@dataclass(frozen=True)
class Latched:
    """Represent an unacknowledged fault in memory.

    Attributes:
        code: its name.
        cause: one plain sentence.
        since_ns: when it was found, on the loop's clock [ns].
    """

    code: str
    cause: str
    since_ns: int


class Latch:
    """Hold the unacknowledged faults of one arm, the earliest first, beyond the single run."""

    def __init__(self) -> None:
        self._faults: dict[str, Latched] = {}

    @property
    def faults(self) -> tuple[Latched, ...]:
        """Return the active faults, the earliest first."""
        return tuple(self._faults.values())

    def set(self, code: str, cause: str, since_ns: int) -> None:
        """Latch a fault; one that is latched already keeps its first cause and time."""
        self._faults.setdefault(code, Latched(code, cause, since_ns))

    def acknowledge(self, code: str) -> Latched:
        """Acknowledge one fault: remove and return it.

        Raises:
            UsageError: no fault of this code is latched; a person must acknowledge a known fault.
        """
        if code not in self._faults:
            known = ", ".join(self._faults) or "none"
            raise UsageError(f"no fault {code!r} is latched (latched: {known})")
        return self._faults.pop(code)
