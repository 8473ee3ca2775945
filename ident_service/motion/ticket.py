"""Judge preflight checks, and write the ticket: what was found, for which arm, motion, model and software.

One JSON object of format `ident-ticket`. The code that moves the arm asks it for `objections_to` the motion; any change
since asks for a new check. It is a record, not a signature: it protects against mistakes, not against people.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from enum import Enum
from math import isfinite
from pathlib import Path
from typing import Any

from drivers.arm import ArmDescription
from ident_service import __version__
from ident_service.config.motion_limits import Vector
from ident_service.errors import MotionRefused, UsageError
from ident_service.excitation.motion_file import Excitation
from ident_service.model.arm_model import ArmModel


class Verdict(Enum):
    """Name the outcomes of a check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"  # it could not be made, or not safely; the reason says why
    NEEDS_PERSON = "needs a person"  # it could be made, but no person has agreed to it


# Every check there is, in the order in which they are made.
CODES = (
    "configuration",
    "motion_fits",
    "motion_proven",
    "stability",
    "identities",
    "at_rest",
    "ways_clear",
    "rate",
    "noise",
    "gravity",
    "direction",
    "watchdog",
)

# What these find is wrong with the motion, or with where the arm stands for it; the arm may be held, and sent home.
ABOUT_THE_MOTION = ("motion_fits", "motion_proven", "ways_clear")
# Nothing replaces these, so that a ticket without them allows nothing, whatever its other checks say.
INDISPENSABLE = ("gravity", "direction", "watchdog")


@dataclass(frozen=True)
class Measure:
    """Represent one measured number and its limits.

    Attributes:
        what: name of the quantity.
        value: measured number; None where it could not be measured or is not finite.
        unit: of the value and the limits.
        joint: name of the joint concerned, or None.
        least: least allowed value, if any.
        most: largest allowed value, if any.
    """

    what: str
    value: float | None
    unit: str
    joint: str | None = None
    least: float | None = None
    most: float | None = None

    @property
    def within_limits(self) -> bool:
        """Return whether the value is between its limits; True without limits, False where limits lack a value."""
        if self.least is None and self.most is None:
            return True
        if self.value is None:
            return False
        return (self.least is None or self.value >= self.least) and (self.most is None or self.value <= self.most)

    def __str__(self) -> str:
        value = "unknown" if self.value is None else f"{self.value:.4g}"
        limits = [f"at least {self.least:.4g}"] if self.least is not None else []
        limits += [f"at most {self.most:.4g}"] if self.most is not None else []
        words = f"{self.what} {value} {self.unit}".rstrip() + (f", {' and '.join(limits)}" if limits else "")
        return words if self.joint is None else f"{self.joint}: {words}"


@dataclass(frozen=True)
class Check:
    """Represent the result of one check.

    Attributes:
        code: one of `CODES`.
        verdict: outcome of the check.
        measures: the measured numbers and their limits.
        reason: failure, or why the check was not made; empty when all is well.
        remedy: one sentence that says what to do; empty when there is nothing to do.
    """

    code: str
    verdict: Verdict
    measures: tuple[Measure, ...] = ()
    reason: str = ""
    remedy: str = ""


def measure(
    quantity: str,
    value: float | None,
    unit: str,
    *,
    joint: str | None = None,
    least: float | None = None,
    most: float | None = None,
) -> Measure:
    """Create a measure from plain numbers; a value that is not finite counts as not measured, such a limit as none."""

    def plain(number: float | None) -> float | None:
        return None if number is None or not isfinite(number) else float(number)

    return Measure(quantity, plain(value), unit, joint, plain(least), plain(most))


def measures(
    quantity: str,
    values: Vector,
    units: Sequence[str],
    joint_names: Sequence[str],
    *,
    least: Vector | None = None,
    most: Vector | None = None,
) -> tuple[Measure, ...]:
    """Create one measure per joint, each of the value, unit, name and limits at its index."""
    return tuple(
        measure(
            quantity,
            float(values[k]),
            units[k],
            joint=name,
            least=None if least is None else float(least[k]),
            most=None if most is None else float(most[k]),
        )
        for k, name in enumerate(joint_names)
    )


def check_from_measures(code: str, taken: Sequence[Measure], remedy: str) -> Check:
    """Return a check: passed where every measure keeps its limits, else failed, naming each that does not."""
    broken = [str(one) for one in taken if not one.within_limits]
    if broken:
        return Check(code, Verdict.FAILED, tuple(taken), "; ".join(broken), remedy)
    return Check(code, Verdict.PASSED, tuple(taken))


def failed_check(code: str, reason: str, remedy: str, measured: Sequence[Measure] = ()) -> Check:
    """Return a check with the verdict FAILED, its reason and remedy."""
    return Check(code, Verdict.FAILED, tuple(measured), reason, remedy)


def skipped_check(code: str, reason: str) -> Check:
    """Return a check with the verdict SKIPPED and the reason why it was not made."""
    return Check(code, Verdict.SKIPPED, (), reason)


def joint_units(revolute: Sequence[bool], turning: str, sliding: str) -> tuple[str, ...]:
    """Return each joint's unit: `turning` for a revolute joint, `sliding` for another."""
    return tuple(turning if turns else sliding for turns in revolute)


FORMAT, VERSION = "ident-ticket", 1
VALID = timedelta(minutes=15)
_MOST_BYTES = 2**20
_HASHES = {
    "arm_sha256": "the arm's description",
    "excitation_sha256": "the motion",
    "model_sha256": "the model's parameters",
    "bus_sha256": "what the drives report of the arm",
}


@dataclass(frozen=True)
class Subject:
    """Identify the arm, motion, model and software that a ticket is about.

    Attributes:
        arm: name.
        arm_sha256: hash of the configuration.
        excitation: name of the motion; empty for none.
        excitation_sha256: hash of the motion's JSON; empty for none.
        model_sha256: hash of the prior parameters.
        identities: answers of the drives about their identity, per axis; empty where no arm could be opened.
        bus_sha256: hash of joint names, rate, limits and resolutions that the open arm reports; empty where none could
            be opened.
        driver: name of the driver's software; empty where no arm could be opened.
        software: name and version of this software.
    """

    arm: str
    arm_sha256: str
    excitation: str
    excitation_sha256: str
    model_sha256: str
    identities: tuple[str, ...]
    bus_sha256: str
    driver: str
    software: str


@dataclass(frozen=True)
class Ticket:
    """Represent the result of a preflight.

    Attributes:
        subject: arm, motion, model and software that were checked.
        checks: all of them, in the order of `CODES`.
        created: UTC, whole milliseconds.
        expires: UTC.
    """

    subject: Subject
    checks: tuple[Check, ...]
    created: datetime
    expires: datetime

    @property
    def verdict(self) -> Verdict:
        """Return FAILED or NEEDS_PERSON if a check has it, else PASSED if all indispensable ones passed, else FAILED.

        Without an indispensable check `objections_to` would allow nothing.
        """
        found = {check.verdict for check in self.checks}
        for worse in (Verdict.FAILED, Verdict.NEEDS_PERSON):
            if worse in found:
                return worse
        made = all(Verdict.PASSED in self._verdicts(code) for code in INDISPENSABLE)
        return Verdict.PASSED if made else Verdict.FAILED

    def _verdicts(self, code: str) -> set[Verdict]:
        return {check.verdict for check in self.checks if check.code == code}

    def objections_to(self, subject: Subject, now: datetime) -> list[str]:
        """Return the reasons why this ticket does not allow a motion now, by checks, age and subject; empty if it does.

        Args:
            subject: subject of the motion that is to begin, with the open arm's own description. One without a motion,
                for the path home, needs the checks of the arm and not those of the motion: that path is checked from
                where it begins, when it begins.
            now: UTC.
        """
        found = []
        no_motion = not subject.excitation_sha256
        failed, asking = (
            [
                check.code
                for check in self.checks
                if check.verdict is verdict and not (no_motion and check.code in ABOUT_THE_MOTION)
            ]
            for verdict in (Verdict.FAILED, Verdict.NEEDS_PERSON)
        )
        left_out = [code for code in INDISPENSABLE if Verdict.PASSED not in self._verdicts(code)]
        if failed:
            found.append(f"checks failed: {', '.join(failed)}")
        if asking:
            codes = ", ".join(code for code in dict.fromkeys([*left_out, *asking]) if code not in failed)
            found.append(f"checks were left out, as nobody typed the arm's name: {codes}")
        elif left_out and not failed:
            found.append(f"checks were not made: {', '.join(left_out)}")
        if now < self.created:
            found.append("it was made in the future: a clock has been set")
        elif now >= self.expires:
            found.append(f"it expired at {self.expires.isoformat(timespec='seconds')}")
        mine, theirs = self.subject, subject
        if mine.arm != theirs.arm:
            found.append(f"it is for {mine.arm}, not for {theirs.arm}")
        for key, what in _HASHES.items():
            if getattr(mine, key) == getattr(theirs, key) or (no_motion and key == "excitation_sha256"):
                continue
            of_home = key == "excitation_sha256" and not mine.excitation_sha256
            found.append("it is for the path home, not for a motion" if of_home else f"{what} has changed since")
        if mine.identities != theirs.identities:
            found.append(f"the drives are not those that were checked{_difference(mine.identities, theirs.identities)}")
        for was, now_is in ((mine.driver, theirs.driver), (mine.software, theirs.software)):
            found += [f"it was made with {was or 'no driver'}, not with {now_is or 'none'}"] if was != now_is else []
        return found

    def require_valid_for(self, subject: Subject, now: datetime) -> None:
        """Raise MotionRefused with the reasons of `objections_to` where this ticket does not allow the motion now."""
        if why := self.objections_to(subject, now):
            command = "`ident preflight` of this motion" if subject.excitation_sha256 else "`ident preflight --home`"
            raise MotionRefused(
                f"the preflight ticket is not valid for this: {'; '.join(why)}; {command} makes a new one"
            )

    def with_arm(self, subject: Subject) -> Subject:
        """Return `subject` with identities, bus and driver of this ticket, to compare the rest with a closed arm."""
        mine = self.subject
        return replace(subject, identities=mine.identities, bus_sha256=mine.bus_sha256, driver=mine.driver)

    def to_json(self) -> str:
        """Return the ticket as one JSON object, the inverse of `ticket_from_json`."""
        return json.dumps(ticket_values(self), indent=1, allow_nan=False)


def _difference(checked: Sequence[str], found: Sequence[str]) -> str:
    """Describe the first axis whose drive reports something else than it did when it was checked; or nothing."""
    for axis, (was, now) in enumerate(zip(checked, found, strict=False), 1):
        if was != now:
            before, after = re.split("[,;] ", was), re.split("[,;] ", now)
            parts = [f"no longer {part}" for part in before if part not in after]
            parts += [f"now {part}" for part in after if part not in before]
            return f" (axis {axis}: {', '.join(parts)})"
    return ""


def subject_of(model: ArmModel, excitation: Excitation | None, described: ArmDescription | None) -> Subject:
    """Return the subject, names and hashes of arm, motion, model, drives and software, that a ticket must have.

    Args:
        model: of the arm.
        excitation: motion to be run; None for the path home.
        described: description by the open arm; None where it could not be opened.
    """
    bus = driver = ""
    axes: tuple[str, ...] = ()
    if described is not None:
        axes, driver = described.identities, described.software
        arrays = (described.torque_limit, described.torque_resolution, described.position_resolution)
        values = [value.tolist() for value in arrays]
        bus = _sha256(repr((described.joint_names, described.rate, values)).encode())
    prior = b"" if model.prior is None else model.prior.astype("<f8").tobytes()
    return Subject(
        arm=model.config.name,
        arm_sha256=model.config.sha256,
        excitation="" if excitation is None else excitation.name,
        excitation_sha256="" if excitation is None else _sha256(excitation.to_json().encode()),
        model_sha256=_sha256(" ".join(model.layout.names).encode() + prior),
        identities=axes,
        bus_sha256=bus,
        driver=driver,
        software=f"ident-service {__version__}",
    )


def new_ticket(subject: Subject, checks: Sequence[Check], now_ns: int, validity: timedelta = VALID) -> Ticket:
    """Create a ticket made at `now_ns` [ns since 1970 in UTC] that expires after `validity`."""
    created = utc(now_ns)
    return Ticket(subject, tuple(checks), created, created + validity)


def utc(now_ns: int) -> datetime:
    """Convert a time [ns since 1970 in UTC] to a date, rounded down to milliseconds."""
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(milliseconds=now_ns // 1_000_000)


def ticket_values(ticket: Ticket) -> dict[str, Any]:
    """Return the ticket as a dict of JSON values: verdict, times, subject and checks with their measures."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "verdict": ticket.verdict.value,
        "created": ticket.created.isoformat(timespec="milliseconds"),
        "expires": ticket.expires.isoformat(timespec="milliseconds"),
        "subject": asdict(ticket.subject) | {"identities": list(ticket.subject.identities)},
        "checks": [
            {
                "code": check.code,
                "verdict": check.verdict.value,
                "reason": check.reason,
                "remedy": check.remedy,
                "measures": [asdict(one) for one in check.measures],
            }
            for check in ticket.checks
        ],
    }


def read_ticket(path: Path) -> Ticket:
    """Read a ticket from its JSON file; raises UsageError where there is none or it is malformed.

    Raises:
        UsageError: no such file, or not a ticket; the message says what is wrong with it.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise UsageError(f"larger than {_MOST_BYTES} bytes, so not a ticket")
        return ticket_from_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UsageError(f"{path}: not UTF-8 text, so not a ticket; `ident preflight` makes a new one") from None
    except UsageError as error:
        raise UsageError(f"{path}: {error}; `ident preflight` makes a new one") from None


def ticket_from_json(text: str) -> Ticket:
    """Parse a ticket from JSON, the inverse of `Ticket.to_json`; UsageError if it is malformed or contradicts itself.

    Raises:
        UsageError: not a ticket; the message says what is wrong with it.
    """
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"not JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise UsageError(f"not a ticket; expected a JSON object whose format is {FORMAT!r}")
    if content.get("version") != VERSION:
        raise UsageError(f"version {content.get('version')!r} of the format; this software reads version {VERSION}")
    _require_keys(content, ("format", "version", "verdict", "created", "expires", "subject", "checks"), "the ticket")
    ticket = Ticket(
        _subject(content["subject"]),
        tuple(_check(one) for one in _list(content["checks"], "checks")),
        _time(content["created"], "created"),
        _time(content["expires"], "expires"),
    )
    if tuple(check.code for check in ticket.checks) != CODES:
        raise UsageError(f"the checks must be {', '.join(CODES)}, each once and in this order")
    if content["verdict"] != ticket.verdict.value:
        raise UsageError(f"says {content['verdict']!r}, but its checks say {ticket.verdict.value!r}")
    return ticket


def _subject(value: Any) -> Subject:
    names = tuple(Subject.__dataclass_fields__)
    _require_keys(value, names, "subject")
    texts = {name: _text(value[name], name) for name in names if name != "identities"}
    identities = tuple(_text(one, "identities") for one in _list(value["identities"], "identities"))
    return Subject(**texts, identities=identities)


def _check(value: Any) -> Check:
    _require_keys(value, ("code", "verdict", "reason", "remedy", "measures"), "a check")
    try:
        verdict = Verdict(value["verdict"])
    except ValueError:
        raise UsageError(f"{value['verdict']!r} is no verdict") from None
    found = tuple(_measure(one) for one in _list(value["measures"], "measures"))
    texts = [_text(value[key], key) for key in ("code", "reason", "remedy")]
    return Check(texts[0], verdict, found, texts[1], texts[2])


def _measure(value: Any) -> Measure:
    _require_keys(value, tuple(Measure.__dataclass_fields__), "a measure")
    joint = value["joint"]
    return Measure(
        _text(value["what"], "what"),
        _number(value["value"], "value"),
        _text(value["unit"], "unit"),
        None if joint is None else _text(joint, "joint"),
        _number(value["least"], "least"),
        _number(value["most"], "most"),
    )


def _require_keys(value: Any, keys: Sequence[str], what: str) -> None:
    if not isinstance(value, dict):
        raise UsageError(f"{what} must be an object")
    if missing := [key for key in keys if key not in value]:
        raise UsageError(f"{what} lacks {', '.join(missing)}")
    if unknown := [key for key in value if key not in keys]:
        raise UsageError(f"{what} has unknown keys: {', '.join(unknown)}")


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise UsageError(f"{what} must be a list")
    return value


def _text(value: Any, what: str) -> str:
    if not isinstance(value, str):
        raise UsageError(f"{what} must be text")
    return value


def _number(value: Any, what: str) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise UsageError(f"{what} must be a finite number or null")
    return float(value)


def _time(value: Any, what: str) -> datetime:
    try:
        time = datetime.fromisoformat(_text(value, what))
    except ValueError:
        raise UsageError(f"{what} is no time: {value!r}") from None
    if time.tzinfo is None or time.utcoffset() != timedelta(0):
        raise UsageError(f"{what} must be UTC")
    return time


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
