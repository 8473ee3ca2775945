"""Cron's five fields, and the next instant that they name: minute, hour, day of month, month, day of week.

Times are UTC: no hour comes twice or never. Fields are `*`, numbers, ranges `1-5`, steps `*/15` and `8-18/2`, lists of
those, and English names of months and days in three letters; 0 and 7 are Sunday. As in Vixie cron, a day must fit both
of its fields where one of them begins with `*`, and else either of them.
Boundary: text and a time in, a time out.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

from ident_service.errors import UsageError

_MONTHS: Final = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
_DAYS: Final = ["sun", "mon", "tue", "wed", "thu", "fri", "sat"]
_FIELDS: Final[tuple[tuple[str, int, int, dict[str, int]], ...]] = (
    ("minute", 0, 59, {}),
    ("hour", 0, 23, {}),
    ("day of month", 1, 31, {}),
    ("month", 1, 12, {name: number for number, name in enumerate(_MONTHS, 1)}),
    ("day of week", 0, 7, {name: number for number, name in enumerate(_DAYS)}),
)
_PART = re.compile(r"(?P<first>\*|\w+)(?:-(?P<last>\w+))?(?:/(?P<step>[0-9]+))?", re.ASCII)
_LONGEST: Final = 200  # characters
# Between two 29ths of February may lie eight years (1896 and 1904), and between two that are a Monday forty.
_FARTHEST: Final = 366 * 41  # days


@dataclass(frozen=True)
class Cron:
    """When something is due.

    Attributes:
        text: as it was given, with single spaces.
        minutes: of an hour.
        hours: of a day.
        days: of a month.
        months: of a year.
        weekdays: 0 is Sunday.
        both: whether a day must fit both fields of days.
    """

    text: str
    minutes: tuple[int, ...]
    hours: tuple[int, ...]
    days: frozenset[int]
    months: frozenset[int]
    weekdays: frozenset[int]
    both: bool

    def after(self, at: float) -> float:
        """The first instant after `at`; both [s since 1970 in UTC].

        Raises:
            UsageError: there is none.
        """
        start = datetime.fromtimestamp(at, UTC).replace(second=0, microsecond=0) + timedelta(minutes=1)
        day, earliest = start.date(), (start.hour, start.minute)
        for _ in range(_FARTHEST):
            if day.month in self.months and self._fits(day.day, day.isoweekday() % 7):
                for hour in self.hours:
                    for minute in self.minutes:
                        if (hour, minute) >= earliest:
                            return datetime(day.year, day.month, day.day, hour, minute, tzinfo=UTC).timestamp()
            day, earliest = day + timedelta(days=1), (0, 0)
        raise UsageError(f"{self.text!r}: no such day ever comes")

    def _fits(self, day: int, weekday: int) -> bool:
        named, called = day in self.days, weekday in self.weekdays
        return (named and called) if self.both else (named or called)


def parse_cron(text: str) -> Cron:
    """Read five fields.

    Raises:
        UsageError: they are not; the message names the field.
    """
    words = text.split() if len(text) <= _LONGEST else []
    if len(words) != len(_FIELDS):
        raise UsageError(f"{text[:_LONGEST]!r}: cron has five fields: {', '.join(field[0] for field in _FIELDS)} (UTC)")
    found = [_field(word.lower(), *field) for word, field in zip(words, _FIELDS, strict=True)]
    weekdays = frozenset(number % 7 for number in found[4])
    both = words[2].startswith("*") or words[4].startswith("*")
    cron = Cron(
        " ".join(words),
        *(tuple(sorted(found[0])), tuple(sorted(found[1])), frozenset(found[2]), frozenset(found[3]), weekdays, both),
    )
    cron.after(0.0)
    return cron


def _field(word: str, name: str, lowest: int, highest: int, names: dict[str, int]) -> set[int]:
    numbers: set[int] = set()
    for part in word.split(","):
        found = _PART.fullmatch(part)
        if found is None or (found["first"] == "*" and found["last"]):
            raise UsageError(f"{part!r}: not a {name} of cron")
        every = found["first"] == "*"
        first = lowest if every else _number(found["first"], names, name)
        last = highest if every or found["step"] else first
        if found["last"]:
            last = _number(found["last"], names, name)
        step = int(found["step"] or 1)
        if not lowest <= first <= last <= highest or step < 1:
            raise UsageError(f"{part!r}: the {name} of cron is from {lowest} to {highest}, in rising order")
        numbers.update(range(first, last + 1, step))
    return numbers


def _number(word: str, names: dict[str, int], name: str) -> int:
    if word in names:
        return names[word]
    if not word.isdigit() or len(word) > 2:
        raise UsageError(f"{word!r}: not a {name} of cron")
    return int(word)
