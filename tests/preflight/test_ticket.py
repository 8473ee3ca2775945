"""Tickets: what they are for, when they count, how they are kept, and what is no ticket."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flight_bench import flight_config, joint_changes

from drivers.arm import ArmDescription
from ident_service.errors import MotionRefused, UsageError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.ticket import (
    CODES,
    Check,
    Subject,
    Ticket,
    Verdict,
    check_from_measures,
    failed_check,
    measure,
    new_ticket,
    read_ticket,
    skipped_check,
    subject_of,
    ticket_from_json,
    ticket_values,
)
from ident_service.operations.arm_checks import ticket_text, write_ticket

NOW_NS = 1_700_000_000 * 10**9
MODEL = arm_model(flight_config())
MOTION = excitation(MODEL, "identification")
ARM = ArmDescription(
    ("shoulder", "elbow"), 1000.0, np.array([40.0, 15.0]), np.zeros(2), np.zeros(2), ("a 1", "b 2"), "sim 1"
)
SUBJECT = subject_of(MODEL, MOTION, ARM)


def ticket(*changed: Check, subject: Subject = SUBJECT) -> Ticket:
    by_code = {check.code: check for check in changed}
    good = measure("drift", 0.01, "rad/s", joint="elbow", most=0.1)
    checks = [by_code.get(code, check_from_measures(code, [good], "do something")) for code in CODES]
    return new_ticket(subject, checks, NOW_NS)


def later(**by: float) -> Any:
    return ticket().created + timedelta(**by)


def test_a_ticket_counts_for_what_was_checked_for_a_quarter_of_an_hour() -> None:
    assert ticket().objections_to(SUBJECT, later(minutes=14, seconds=59)) == []
    assert "expired" in ticket().objections_to(SUBJECT, later(minutes=15))[0]
    assert "clock" in ticket().objections_to(SUBJECT, later(seconds=-1))[0]


@pytest.mark.parametrize(
    ("verdict", "reason"),
    [
        (failed_check("noise", "too much", "less"), "failed: noise"),
        (Check("watchdog", Verdict.NEEDS_PERSON), "left out, as nobody typed the arm's name: watchdog"),
        *(
            (skipped_check(code, "could not be made"), f"not made: {code}")
            for code in ("gravity", "direction", "watchdog")
        ),
    ],
)
def test_a_ticket_that_did_not_pass_counts_for_nothing(verdict: Check, reason: str) -> None:
    (found,) = ticket(verdict).objections_to(SUBJECT, later())
    assert reason in found
    assert ticket(verdict).verdict is not Verdict.PASSED


def test_checks_that_want_a_person_are_not_said_to_have_failed() -> None:
    why = "because nobody typed the arm's name"
    person = Check("watchdog", Verdict.NEEDS_PERSON)
    left_out = ticket(skipped_check("gravity", why), skipped_check("direction", why), person)
    assert left_out.objections_to(SUBJECT, later()) == [
        "checks were left out, as nobody typed the arm's name: gravity, direction, watchdog"
    ]


def test_a_ticket_for_the_path_home_says_so_to_a_motion() -> None:
    home = subject_of(MODEL, None, ARM)
    with pytest.raises(MotionRefused) as refused:
        ticket(subject=home).require_valid_for(SUBJECT, later())
    assert str(refused.value) == (
        "the preflight ticket is not valid for this: it is for the path home, not for a motion; "
        "`ident preflight` of this motion makes a new one"
    )
    with pytest.raises(MotionRefused, match="`ident preflight --home` makes a new one"):
        ticket().require_valid_for(home, later(minutes=15))


def test_failure_outweighs_a_missing_person_and_skipped_checks_pass() -> None:
    person = Check("watchdog", Verdict.NEEDS_PERSON)
    assert ticket(person, failed_check("noise", "x", "y")).verdict is Verdict.FAILED
    assert ticket(person).verdict is Verdict.NEEDS_PERSON
    assert ticket(skipped_check("rate", "virtual")).verdict is Verdict.PASSED


def of_config(**changes: Any) -> Subject:
    model = arm_model(flight_config(**changes))
    return subject_of(model, excitation(model, "identification"), ARM)


OTHERS: list[tuple[Callable[[], Subject], str]] = [
    (lambda: of_config(joints=joint_changes("elbow", kp=399.0)), "the arm's description has changed"),
    (lambda: of_config(description="moved to another cell"), "the arm's description has changed"),
    (lambda: of_config(name="other"), "it is for bench, not for other"),
    (lambda: subject_of(MODEL, replace(MOTION, name="validation"), ARM), "the motion has changed"),
    (lambda: subject_of(replace(MODEL, prior=1.01 * MODEL.prior), MOTION, ARM), "the model's parameters"),
    (lambda: subject_of(MODEL, MOTION, replace(ARM, identities=("a 1", "b 3"))), "the drives are not those"),
    (lambda: subject_of(MODEL, MOTION, replace(ARM, rate=500.0)), "the drives report"),
    (lambda: subject_of(MODEL, MOTION, replace(ARM, torque_limit=np.array([40.0, 14.0]))), "the drives report"),
    (lambda: subject_of(MODEL, MOTION, replace(ARM, software="sim 2")), "it was made with sim 1, not with sim 2"),
    (lambda: replace(SUBJECT, software="ident-service 9"), "not with ident-service 9"),
    (lambda: subject_of(MODEL, MOTION, None), "the drives are not those"),
]


@pytest.mark.parametrize(("other", "reason"), OTHERS)
def test_any_change_asks_for_a_new_check(other: Callable[[], Subject], reason: str) -> None:
    found = ticket().objections_to(other(), later())
    assert any(reason in one for one in found), found


@pytest.mark.parametrize("code", ["motion_fits", "motion_proven", "ways_clear"])
def test_a_path_home_asks_for_nothing_that_is_about_the_motion(code: str) -> None:
    home = subject_of(MODEL, None, ARM)
    assert ticket(failed_check(code, "not this motion", "another")).objections_to(home, later()) == []
    assert ticket(failed_check(code, "not this motion", "another")).objections_to(SUBJECT, later()) != []


@pytest.mark.parametrize("check", [failed_check("direction", "x", "y"), Check("watchdog", Verdict.NEEDS_PERSON)])
def test_a_path_home_asks_for_all_that_is_about_the_arm(check: Check) -> None:
    home = subject_of(MODEL, None, ARM)
    assert ticket(check).objections_to(home, later())[0].endswith(f": {check.code}")
    others = subject_of(MODEL, None, replace(ARM, identities=("a 1", "b 3")))
    assert "the drives are not those that were checked (axis 2: no longer b 2, now b 3)" in ticket().objections_to(
        others, later()
    )
    assert "expired" in ticket().objections_to(home, later(minutes=15))[0]


def test_what_does_not_matter_does_not_change_the_subject() -> None:
    again = arm_model(flight_config())
    assert subject_of(again, excitation(again, "identification"), replace(ARM)) == SUBJECT


def test_a_ticket_is_kept_to_the_last_bit(tmp_path: Path) -> None:
    made = ticket(
        failed_check("noise", "elbow: 1/3", "shield it", [measure("std", 1.0 / 3.0, "rad", joint="elbow", most=0.1)]),
        skipped_check("rate", "virtual"),
        check_from_measures("gravity", [measure("difference", float("nan"), "N m")], "x"),
    )
    path = tmp_path / "ticket.json"
    write_ticket(path, made)
    assert read_ticket(path) == made
    assert list(tmp_path.iterdir()) == [path]
    assert json.loads(path.read_text(encoding="utf-8")) == ticket_values(made)


def changed(change: Callable[[dict[str, Any]], None]) -> str:
    content = ticket_values(ticket())
    change(content)
    return json.dumps(content)


NO_TICKETS: list[tuple[str, str]] = [
    ("", "not JSON"),
    ("[" * 100000, "not JSON"),
    ("[]", "not a ticket"),
    ('{"format": "ident-excitation"}', "not a ticket"),
    (changed(lambda c: c.update(version=2)), "version 2"),
    (changed(lambda c: c.pop("expires")), "lacks expires"),
    (changed(lambda c: c.update(extra=1)), "unknown keys: extra"),
    (changed(lambda c: c.update(verdict="failed")), "says 'failed', but its checks say 'passed'"),
    (changed(lambda c: c["checks"].pop()), "each once and in this order"),
    (changed(lambda c: c["checks"].reverse()), "each once and in this order"),
    (changed(lambda c: c["checks"][0].update(verdict="fine")), "'fine' is no verdict"),
    (changed(lambda c: c["checks"][0].update(measures={})), "measures must be a list"),
    (changed(lambda c: c["checks"][0]["measures"][0].update(value="1")), "value must be a finite number"),
    (changed(lambda c: c["checks"][0]["measures"][0].update(value=True)), "value must be a finite number"),
    (changed(lambda c: c["checks"][0].update(reason=None)), "reason must be text"),
    (changed(lambda c: c["subject"].update(identities=[1])), "identities must be text"),
    (changed(lambda c: c.update(subject=[])), "subject must be an object"),
    (changed(lambda c: c.update(created="yesterday")), "created is no time"),
    (changed(lambda c: c.update(created="2026-01-01T00:00:00")), "created must be UTC"),
    (changed(lambda c: c.update(created="2026-01-01T00:00:00+01:00")), "created must be UTC"),
]


@pytest.mark.parametrize(("text", "complaint"), NO_TICKETS)
def test_what_is_no_ticket_is_refused_with_one_reason(text: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"\w") as caught:
        ticket_from_json(text)
    assert complaint in str(caught.value)
    path = tmp_path / "ticket.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError) as again:
        read_ticket(path)
    assert str(again.value).startswith(f"{path}: ")
    assert str(again.value).endswith("`ident preflight` makes a new one")
    assert complaint in str(again.value)


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read"):
        read_ticket(tmp_path / "none.json")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="UTF-8"):
        read_ticket(tmp_path / "binary")
    (tmp_path / "large").write_bytes(b" " * (2**20 + 1))
    with pytest.raises(UsageError, match="larger than"):
        read_ticket(tmp_path / "large")
    with pytest.raises(UsageError, match="cannot be written"):
        write_ticket(tmp_path / "no folder" / "ticket.json", ticket())


def test_the_text_says_what_to_do() -> None:
    text = ticket_text(ticket())
    assert "the arm may move until 2023-11-14 22:28:20 UTC" in text
    assert "elbow: drift 0.01 rad/s, at most 0.1" in text
    text = ticket_text(
        ticket(failed_check("noise", "elbow: too loud", "Check shielding."), skipped_check("direction", "because"))
    )
    assert "NOT ALLOWED TO MOVE" in text
    assert "FAILED     feedback is quiet" in text
    assert "-> Check shielding." in text
    assert "NEEDS YOU" in ticket_text(ticket(Check("watchdog", Verdict.NEEDS_PERSON, (), "nobody", "Type it.")))
