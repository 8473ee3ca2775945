"""Read cron's five fields and find the next instant that they name, by cronsim, which follows Debian's cron.

Times are UTC: no hour comes twice or never. Beside numbers, ranges, steps, lists and English names in three letters,
cronsim knows `L` (last day of the month, `5L`: last Friday) and `1#2` (second Monday).
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from cronsim import CronSim, CronSimError

from ident_service.errors import UsageError

_FIELDS: Final = 5
_LONGEST: Final = 200  # characters


@dataclass(frozen=True)
class Cron:
    """Times given by cron's five fields.

    Attributes:
        text: the five fields as they were given, with single spaces.
    """

    text: str

    def after(self, at: float) -> float:
        """Return the first instant after `at`; both [s since 1970 in UTC].

        Raises:
            UsageError: no such day comes within fifty years.
        """
        found = next(CronSim(self.text, datetime.fromtimestamp(at, UTC)), None)
        if found is None:
            raise UsageError(f"{self.text!r}: no such day ever comes")
        return found.timestamp()


def parse_cron(text: str) -> Cron:
    """Parse cron's five fields: minute, hour, day of month, month, day of week.

    Raises:
        UsageError: they are not; the message names the field.
    """
    words = text.split() if len(text) <= _LONGEST else []
    if len(words) != _FIELDS:
        raise UsageError(f"{text[:_LONGEST]!r}: cron has five fields: minute, hour, day of month, month, day of week")
    cron = Cron(" ".join(words))
    try:
        cron.after(0.0)
    except CronSimError as error:
        # cronsim names the field: "Bad day-of-month", also for a day that its months never have.
        raise UsageError(f"{cron.text!r}: {str(error).lower()} in cron's five fields") from None
    return cron
