"""Cron's fields against a second reading of them, minute by minute; and what is refused."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident_service.errors import UsageError
from ident_service.operations.maintenance_schedule import parse_cron

BOUNDS = ((0, 59), (0, 23), (1, 31), (1, 12), (0, 7))


def named(word: str, value: int, lowest: int, highest: int) -> bool:
    """Whether a field of numbers names a value; written anew, by looking at each part."""
    for part in word.split(","):
        span, _, step = part.partition("/")
        first, dash, last = span.partition("-")
        if span == "*":
            low, high = lowest, highest
        else:
            low = int(first)
            high = int(last) if dash else highest if step else low
        if low <= value <= high and (value - low) % int(step or 1) == 0:
            return True
    return False


def fits(text: str, when: datetime) -> bool:
    """Whether a minute is named, as the manual of Vixie's cron says."""
    minute, hour, day, month, weekday = text.split()
    if not (named(minute, when.minute, 0, 59) and named(hour, when.hour, 0, 23) and named(month, when.month, 1, 12)):
        return False
    by_day = named(day, when.day, 1, 31)
    sunday_first = (when.weekday() + 1) % 7
    by_weekday = named(weekday, sunday_first, 0, 7) or (sunday_first == 0 and named(weekday, 7, 0, 7))
    return (by_day and by_weekday) if day[0] == "*" or weekday[0] == "*" else (by_day or by_weekday)


@st.composite
def field(draw: st.DrawFn, lowest: int, highest: int) -> str:
    def part() -> str:
        low, high = sorted((draw(st.integers(lowest, highest)), draw(st.integers(lowest, highest))))
        step = draw(st.integers(1, 20))
        # cronsim reads a range of one number with a step, 5-5/2, as 5/2; Debian's cron as 5.
        if low == high:
            return draw(st.sampled_from(["*", str(low), f"{low}-{high}"]))
        return draw(st.sampled_from(["*", f"*/{step}", str(low), f"{low}-{high}", f"{low}-{high}/{step}"]))

    return ",".join(part() for _ in range(draw(st.integers(1, 3))))


# Hours and minutes are few, so that a search minute by minute stays short; days and months are what is intricate.
FIELDS = st.tuples(field(0, 59), field(0, 23), field(1, 28), st.just("*"), field(0, 7))
STARTS = st.datetimes(datetime(1999, 1, 1), datetime(2101, 1, 1))


@pytest.mark.slow
@given(FIELDS, STARTS)
def test_the_next_instant_is_the_first_minute_that_is_named(words: tuple[str, ...], start: datetime) -> None:
    text, start = " ".join(words), start.replace(tzinfo=UTC)
    found = datetime.fromtimestamp(parse_cron(text).after(start.timestamp()), UTC)
    assert fits(text, found)
    assert found > start
    assert (found.second, found.microsecond) == (0, 0)
    # No minute in between is named: whole days where no day fits, minutes elsewhere.
    minute = start.replace(second=0, microsecond=0) + timedelta(minutes=1)
    looked = 0
    while minute < found and looked < 3000:
        assert not fits(text, minute)
        minute, looked = minute + timedelta(minutes=1), looked + 1


@given(field(1, 31), field(1, 12), field(0, 7), STARTS)
def test_days_and_months(day: str, month: str, weekday: str, start: datetime) -> None:
    text, start = f"0 0 {day} {month} {weekday}", start.replace(tzinfo=UTC)
    midnight = start.replace(hour=0, minute=0, second=0, microsecond=0) + timedelta(days=1)
    expected = next((at for at in (midnight + timedelta(days=k) for k in range(366 * 41)) if fits(text, at)), None)
    if expected is None:
        with pytest.raises(UsageError, match=r"no such day|bad day-of-month"):
            parse_cron(text)
    else:
        assert parse_cron(text).after(start.timestamp()) == expected.timestamp()


@pytest.mark.parametrize(
    ("text", "start", "expected"),
    [
        ("0 6 * * mon", "2026-01-05 06:00", "2026-01-12 06:00"),
        ("0 6 * * 1", "2026-01-05 05:59", "2026-01-05 06:00"),
        ("30 2 29 feb *", "2097-01-01 00:00", "2104-02-29 02:30"),
        ("0 0 13 * fri", "2026-01-05 00:00", "2026-01-09 00:00"),  # either
        ("0 0 */2 * fri", "2026-01-01 00:00", "2026-01-09 00:00"),  # both
        ("59 23 31 DEC 0", "2026-12-31 23:59", "2027-12-05 23:59"),
        ("0 0 L * *", "2026-02-01 00:00", "2026-02-28 00:00"),
        ("0 1 * * 7", "2026-03-29 00:30", "2026-03-29 01:00"),  # an hour that Central Europe's clocks leave out
    ],
)
def test_known_instants(text: str, start: str, expected: str) -> None:
    at = datetime.fromisoformat(f"{start}+00:00").timestamp()
    assert datetime.fromtimestamp(parse_cron(text).after(at), UTC).strftime("%Y-%m-%d %H:%M") == expected


@pytest.mark.parametrize(
    "text",
    [
        "",
        "* * * *",
        "* * * * * *",
        "60 * * * *",
        "* 24 * * *",
        "* * 0 * *",
        "* * * 13 *",
        "* * * * 8",
        "*/0 * * * *",
        "5-1 * * * *",
        "a * * * *",
        "*-3 * * * *",
        "1,,2 * * * *",
        "-1 * * * *",
        "0 0 30 feb *",
        "0 0 31 4,6 *",
        "٣ * * * *",
        "1/ * * * *",
        "999 * * * *",
        "0 " * 300,
        "* * * * fri-mon",
    ],
)
def test_what_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_cron(text)
