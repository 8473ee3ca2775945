"""Pages of maintenance as text: what they take, what they refuse, and the words they have for it."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from urllib.parse import urlencode

import pytest
from daemon.conftest import Asked
from page.test_pages import ARM, FORM, complaints, enter
from page.test_pages import commissioned as commissioned
from page.test_pages import daemon as daemon

from ident_service.daemon.maintenance.reidentification import reidentifications
from ident_service.operations.drift_alarms import alarms, verdict_of
from ident_service.operations.maintenance_schedule import events, pending, schedules
from ident_service.operations.parameter_files import compare_into
from ident_service.registry import jobs as rows
from ident_service.registry.database import audit_log
from ident_service.registry.state_folder import arm_fault_store


def sent(daemon: Asked, address: str, **fields: str) -> tuple[int, str]:
    """Status and text of the page that a form is answered with."""
    answer = daemon.post(address, content=urlencode(fields), headers=FORM)
    assert answer.status_code == 303 or complaints(answer.text) == [], address
    return answer.status_code, answer.text


@pytest.mark.parametrize(
    ("fields", "bad"),
    [
        ({"when": "cron", "cron": "0 25 * * *"}, True),
        ({"when": "cron", "cron": "every day"}, True),
        ({"when": "hours", "hours": "-3"}, True),
        ({"when": "hours", "hours": "soon"}, True),
        ({"when": "hours", "hours": "inf"}, True),
        ({"when": "nothing"}, True),
        ({"when": "maintenance", "motion": "unknown"}, True),
        ({"when": "maintenance", "cron": "rubbish", "hours": "rubbish"}, False),
        ({"when": "hours", "hours": "250.5"}, False),
        ({"when": "cron", "cron": "30 5 1 * *"}, False),
    ],
)
def test_a_schedule_is_taken_or_refused_with_the_words_of_the_api(
    daemon: Asked, fields: dict[str, str], bad: bool
) -> None:
    enter(daemon, "operator")
    db = daemon.service.db
    before = schedules(db, ARM)
    status, text = sent(daemon, f"/arms/{ARM}/schedules", **fields)
    if not bad:
        assert status == 303
        (added,) = [row for row in schedules(db, ARM) if row not in before]
        assert added["created_by"] == "operator"
        number = added["id"]
        assert sent(daemon, f"/schedules/{number}/enabled", wanted="disable")[0] == 303
        assert [row["enabled"] for row in schedules(db, ARM) if row["id"] == number] == [0]
        assert sent(daemon, f"/schedules/{number}/enabled", wanted="enable")[0] == 303
        assert sent(daemon, f"/schedules/{number}/remove")[0] == 303
        assert sent(daemon, f"/schedules/{number}/remove")[0] == 404
        assert schedules(db, ARM) == before
        return
    assert schedules(db, ARM) == before
    body = {"arm": ARM, "maintenance": fields["when"] == "maintenance"}
    body |= {key: value for key, value in fields.items() if key == fields["when"] or key == "motion"}  # type: ignore[misc]
    answer = daemon.post("/api/v1/schedules", body, headers={"Origin": FORM["Origin"]})
    assert answer.status_code == status
    shown = re.search(r'role="alert" id="problem">([^<]+)<', text)
    assert shown is not None
    told = answer.json()["error"]["message"].replace("body.", "").replace("'", "&#39;")
    assert shown[1] == told
    for value in fields.values():  # as it was filled in
        assert value == "unknown" or f'value="{value}"' in text or value == "nothing"


def test_maintenance_is_entered_and_what_is_due_is_dismissed(daemon: Asked) -> None:
    enter(daemon, "operator")
    db = daemon.service.db
    status, text = sent(daemon, f"/arms/{ARM}/maintenance", what="", note="kept words")
    assert (status, 'value="kept words"' in text, len(events(db, ARM))) == (422, True, 1)
    assert sent(daemon, f"/arms/{ARM}/maintenance", what="w" * 201, note="")[0] == 422
    (due,) = pending(db, ARM)
    assert sent(daemon, f"/due/{due['id']}/dismiss", note=" ")[0] == 422
    assert len(pending(db, ARM)) == 1
    assert sent(daemon, f"/due/{due['id']}/dismiss", note="the same belt")[0] == 303
    assert pending(db, ARM) == []
    assert sent(daemon, f"/due/{due['id']}/dismiss", note="again")[0] == 400
    assert sent(daemon, f"/arms/{ARM}/maintenance", what="belt & pulley", note="")[0] == 303
    assert [row["cause"] for row in pending(db, ARM)] == ["maintenance: belt & pulley"]
    for address in ("/", f"/arms/{ARM}", f"/arms/{ARM}/maintenance"):
        assert "maintenance: belt &amp; pulley" in daemon.get(address).text


def test_an_alarm_needs_a_note_to_be_acknowledged(daemon: Asked) -> None:
    enter(daemon, "operator")
    db = daemon.service.db
    number = alarms(db)[0]["id"]
    for address in ("/", f"/arms/{ARM}"):
        text = daemon.get(address).text
        assert f'<p role="alert">{ARM} is not the arm any more that was accepted.' in text
    assert sent(daemon, f"/alarms/{number}/ack", note="  ")[0] == 422
    assert len(alarms(db)) == 1
    assert sent(daemon, f"/alarms/{number}/ack", note="seal ordered")[0] == 303
    assert sent(daemon, f"/alarms/{number}/ack", note="seal ordered")[0] == 404
    assert (alarms(db), alarms(db, closed=True)[0]["how"]) == ([], "seal ordered")
    assert "Drift alarm" not in daemon.get("/").text


def test_the_workflow_says_re_identify_when_something_asks_for_it(daemon: Asked) -> None:
    enter(daemon, "operator")
    db = daemon.service.db

    def current() -> str:
        found = re.search(r'id="step-(\w+)" aria-current="step"', daemon.get(f"/arms/{ARM}").text)
        assert found is not None
        return found[1]

    assert current() == "again"
    sent(daemon, f"/alarms/{alarms(db)[0]['id']}/ack", note="known")
    assert current() == "again"  # it is due still
    sent(daemon, f"/due/{pending(db, ARM)[0]['id']}/dismiss", note="not now")
    assert current() == "check"
    # An arm of which nothing was accepted cannot be compared, whatever is due.
    sent(daemon, "/arms/planar2/schedules", when="maintenance")
    sent(daemon, "/arms/planar2/maintenance", what="belt")
    text = daemon.get("/arms/planar2").text
    assert 'id="step-check" aria-current="step"' in text
    assert "/arms/planar2/reidentify/confirm" not in text
    assert sent(daemon, "/arms/planar2/reidentify/confirm")[0] == 400


@pytest.mark.slow
def test_a_re_identification_needs_the_typed_name_and_a_fresh_page(daemon: Asked) -> None:
    enter(daemon, "operator")
    db = daemon.service.db
    arm_fault_store(daemon.service.state, ARM).acknowledge("FOLLOWING_ERROR")
    before = len(reidentifications(db))

    def challenge() -> str:
        found = re.search(r'name="challenge" value="([^"]+)"', sent(daemon, f"/arms/{ARM}/reidentify/confirm")[1])
        assert found is not None
        return found[1]

    word = challenge()
    for name, given in (("planar2", word), (ARM, word), (ARM, "x"), ("", challenge())):
        status, text = sent(daemon, f"/arms/{ARM}/reidentify", name=name, challenge=given, note="kept words")
        assert (status, "Nothing has moved" in text, 'value="kept words"' in text) == (409, True, True)
    assert sent(daemon, f"/arms/{ARM}/reidentify", name=ARM, challenge=challenge(), note="w" * 2001)[0] == 400
    assert len(reidentifications(db)) == before
    assert not rows.jobs(db, arm=ARM, states=rows.LIVE)

    form = urlencode({"name": ARM, "challenge": challenge(), "note": "as planned"})
    answer = daemon.post(f"/arms/{ARM}/reidentify", content=form, headers=FORM)
    assert answer.status_code == 303
    where = answer.headers["location"]
    page = daemon.get(where).text
    assert complaints(page) == []
    assert 'data-lease="keep"' in page
    assert "as planned" in page
    assert [line["detail"] for line in audit_log(db) if line["what"] == "re-identification note"] == [
        {"note": "as planned"}
    ]
    assert f'<a href="{where.split("?")[0]}">show</a>' in daemon.get(f"/arms/{ARM}").text
    assert sent(daemon, f"/arms/{ARM}/reidentify", name=ARM, challenge=challenge())[0] == 409  # it is under way
    # Whoever comes to it by another way only looks, and so does another person.
    assert "data-lease" not in daemon.get(where.split("?")[0]).text
    operator = daemon.headers["Cookie"]
    enter(daemon, "viewer")
    assert "data-lease" not in daemon.get(where).text
    assert sent(daemon, f"{where.split('?')[0]}/cancel")[0] == 403
    daemon.headers["Cookie"] = operator
    assert sent(daemon, f"{where.split('?')[0]}/cancel")[0] == 303
    until = time.monotonic() + 60.0
    while (row := reidentifications(db)[0])["state"] == "running":
        assert time.monotonic() < until
        time.sleep(0.1)
    assert (row["state"], row["step"]) == ("cancelled", "check")
    assert sent(daemon, f"{where.split('?')[0]}/cancel")[0] == 400
    page = daemon.get(where).text
    assert complaints(page) == []
    assert "It ended without a verdict." in page


def test_a_comparison_that_is_not_the_one_concluded_from_is_not_shown(daemon: Asked, commissioned: Path) -> None:
    enter(daemon, "viewer")
    folder = daemon.service.state / "runs" / commissioned.name

    def shown() -> int:
        answer = daemon.get("/reidentifications/again/comparison")
        assert "<script>" not in answer.text
        assert str(daemon.service.state) not in answer.text
        return answer.status_code

    assert shown() == 404  # there is none
    compare_into(folder, folder)
    assert shown() == 404  # it says something else than what was concluded
    words = verdict_of(json.loads((folder / "comparison.json").read_text())).words
    assert words.startswith("unchanged")
    daemon.service.db.write("UPDATE reidentifications SET state = 'unchanged', detail = ?", words)
    assert shown() == 200
    assert "Read the comparison" in daemon.get("/reidentifications/again").text
    with (folder / "comparison.html").open("a") as page:
        page.write("<p>and more</p>")
    assert shown() == 404  # it is not what the manifest names any more
    assert "Read the comparison" not in daemon.get("/reidentifications/again").text
    for name in ("none", "..%2f..", "again/x"):
        assert daemon.get(f"/reidentifications/{name}").status_code in (404, 422)
