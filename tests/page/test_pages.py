"""Pages as text: who may see them, nothing unescaped, and what a screen reader needs."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator
from html import unescape
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from daemon.conftest import URL, Asked, known_arm, quick_text, serving
from daemon.conftest import commissioned as commissioned
from fastapi.routing import APIRoute

from ident_service.cli import main
from ident_service.daemon.app import PAGES
from ident_service.daemon.jobs.requests import Base
from ident_service.daemon.maintenance.reidentification import enter_concluded
from ident_service.daemon.web.render import STATIC, static_files, static_version
from ident_service.daemon.web.run_pages import IdentifiedSet
from ident_service.operations.drift_alarms import Verdict, alarms
from ident_service.operations.maintenance_schedule import DueRule, add_event, add_schedule, events, pending, schedules
from ident_service.operations.run_archive import import_run
from ident_service.recordings.open import open_recording
from ident_service.registry import jobs as rows
from ident_service.registry.runs import label_run
from ident_service.registry.state_folder import arm_fault_store, arm_folder, control_path
from ident_service.registry.tokens import add_token
from ident_service.results.manifest import write_manifest

ARM = "quick"
EVIL = "<script>alert('x')</script>\"'&"
FORM = {"Content-Type": "application/x-www-form-urlencoded", "Origin": URL}
VOID = {"meta", "link", "input", "br", "hr", "img"}


@pytest.fixture
def daemon(state: Path, commissioned: Path) -> Iterator[Asked]:
    """A service with one of everything, hostile words wherever words may stand."""
    with serving(state) as asked:
        evil = quick_text(ARM).replace("planar arm of two links, gravity in its plane", repr(EVIL.replace("'", "")))
        known_arm(asked, evil)
        db = asked.service.db
        import_run(db, state, commissioned, "test")
        answer = asked.post(f"/api/v1/arms/{ARM}/acceptances", {"run": commissioned.name, "note": EVIL})
        assert answer.status_code == 201, answer.text
        arm_folder(state, ARM).mkdir(parents=True, exist_ok=True)
        arm_fault_store(state, ARM).latch("FOLLOWING_ERROR", EVIL)
        label_run(db, commissioned.name, ["belt"], EVIL, EVIL)
        rows.add_job(db, "j1", "run", ARM, {"kind": "run"}, [], "test", motion=True, run_id="none")
        rows.mark_ended(db, "j1", "failed", EVIL)
        (state / "jobs" / "j1").mkdir(parents=True)
        (state / "jobs" / "j1" / "log").write_text(EVIL)
        now = time.time()
        for when in (DueRule(cron="0 6 29 2 *"), DueRule(hours=500.0), DueRule(maintenance=True)):
            add_schedule(db, ARM, when, EVIL, now)
        add_event(db, ARM, EVIL, EVIL, EVIL, now)  # and so it is due
        verdict = Verdict("changed", f"changed: {EVIL}")
        again = enter_concluded(db, ARM, 1, "none", commissioned.name, verdict, now - 60.0, EVIL, now)
        db.write("UPDATE reidentifications SET id = 'again' WHERE id = ?", again)
        db.write("UPDATE alarms SET reidentification = 'again'")
        asked.headers.clear()
        yield asked


def enter(daemon: Asked, role: str) -> None:
    """Go on with a session of this role."""
    secret = add_token(daemon.service.db, role, role, "test")  # type: ignore[arg-type]
    answer = daemon.post("/login", content=f"token={secret}&next=%2Fjobs", headers=FORM)
    assert (answer.status_code, answer.headers["location"]) == (303, "/jobs")
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    daemon.headers["Cookie"] = cookie.split(";")[0]


def addresses(commissioned: Path) -> list[str]:
    return ["/", f"/arms/{ARM}", "/arms/planar2", "/jobs", "/jobs/j1", "/runs", f"/runs?arm={ARM}",
            f"/runs/{commissioned.name}", "/audit", f"/arms/{ARM}/maintenance", "/arms/planar2/maintenance",
            "/reidentifications/again", f"/runs?arm={ARM}&parameter=fc1", f"/arms/{ARM}/parameters",
            "/arms/ur10"]  # fmt: skip


class Reader(HTMLParser):
    """Collects what the checks ask about."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.unbalanced: list[str] = []
        self.labelled: list[bool] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.labelled.append("label" in self.open)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.unbalanced.append(tag)


def complaints(text: str) -> list[str]:
    """What stands against a page."""
    page = Reader(text)
    named = [tag for tag, _ in page.tags]
    ids = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
    found = [f"unbalanced {tag}" for tag in page.unbalanced + page.open]
    found += [f"{named.count(tag)} {tag}" for tag in ("h1", "main", "header", "title") if named.count(tag) != 1]
    found += [f"id {one} twice" for one in set(ids) if ids.count(one) > 1]
    targets = {attrs.get("for") for tag, attrs in page.tags if tag == "label"}
    for (tag, attrs), inside in zip(page.tags, page.labelled, strict=True):
        asks = tag in ("input", "select", "textarea", "progress") and attrs.get("type") != "hidden"
        if asks and not inside and attrs.get("id") not in targets:
            found.append(f"no label: {attrs}")
        found += [f"inline {key} at {tag}" for key in attrs if key == "style" or key.startswith("on")]
        if tag == "script" and "src" not in attrs:
            found.append("inline script")
        for key in ("aria-labelledby", "aria-describedby"):
            if key in attrs and attrs[key] not in ids:
                found.append(f"{key} names nothing: {attrs[key]}")
        if tag == "th" and "scope" not in attrs:
            found.append("a th without scope")
    levels = [int(tag[1]) for tag in named if re.fullmatch("h[1-6]", tag)]
    found += [f"h{b} after h{a}" for a, b in pairwise(levels) if b > a + 1]
    if ("html", {"lang": "en"}) not in page.tags:
        found.append("no language")
    if not any(tag == "form" and attrs.get("action") == "/stop" for tag, attrs in page.tags):
        found.append("no stop")
    return found


def test_complaints_are_found() -> None:
    bad = '<html><h1>a</h1><h3>b</h3><input id=x><p onclick="x">c<script>1</script><b aria-labelledby=y>'
    words = " ".join(complaints(bad))
    for part in ("unbalanced", "0 main", "h3 after h1", "no label", "inline onclick", "inline script", "y", "no stop"):
        assert part in words


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_every_page_answers_whole_and_escaped(daemon: Asked, commissioned: Path, role: str) -> None:
    enter(daemon, role)
    shown = 0
    for address in addresses(commissioned):
        answer = daemon.get(address)
        assert answer.status_code == 200, (address, answer.text)
        assert complaints(answer.text) == [], address
        assert "<script>" not in answer.text
        shown += answer.text.count("&lt;script&gt;")
        assert f"{role} <small>({role})</small>" in answer.text
        policy = answer.headers["content-security-policy"]
        assert "unsafe" not in policy
        assert "default-src 'none'" in policy
        assert answer.headers["referrer-policy"] == "same-origin"
        assert str(daemon.service.state) not in answer.text
        posting = [attrs for tag, attrs in Reader(answer.text).tags if tag == "form" and attrs.get("method") == "post"]
        if role == "viewer":  # nothing but stop and the way out
            assert {attrs["action"] for attrs in posting} == {"/stop", "/logout"}, address
    assert shown >= 12  # description, fault, note, detail, log, audit, alarm, cause, what was done, by whom


def test_strangers_are_led_to_the_login(daemon: Asked, commissioned: Path) -> None:
    for address in [*addresses(commissioned), "/new", f"/compare?reference=a&other={ARM}"]:
        answer = daemon.get(address)
        assert answer.status_code == 303, address
        assert answer.headers["location"].startswith("/login?next=%2F")
    filled = {"arm": ARM, "job": "j1", "run": commissioned.name, "name": "n", "version": "v", "number": 1}
    open_to_all = {"/login", "/logout", "/static/{version}/{name}", "/stop", "/api/docs"}
    tried = 0
    for route in (route for router in PAGES for route in router.routes if isinstance(route, APIRoute)):
        for method in () if route.path in open_to_all else route.methods:
            tried += 1
            answer = daemon.ask(method, route.path.format(**filled), headers=FORM)
            assert (answer.status_code, "/login" in answer.headers.get("location", "")) == (303, True), route.path
    assert tried >= 35
    for address in ("/new", f"/arms/{ARM}/move", f"/arms/{ARM}/accept", "/jobs/j1/cancel"):
        answer = daemon.post(address, content="a=b", headers=FORM)
        assert (answer.status_code, answer.headers["location"]) == (303, "/login?next=%2F"), address
    answer = daemon.get("/login?next=//elsewhere.example/")
    assert complaints(answer.text) == []
    assert 'name="next" value="/"' in answer.text
    answer = daemon.post("/login", content=f"token={EVIL}", headers=FORM)
    assert answer.status_code == 401
    assert "set-cookie" not in answer.headers


def test_a_viewer_may_do_nothing_with_forms(daemon: Asked, commissioned: Path) -> None:
    enter(daemon, "viewer")
    sent = f"kind=run&run={commissioned.name}&note=n&name={ARM}&code=FOLLOWING_ERROR"
    motions = ("confirm", "move", "pause", "finish", "supported", "reidentify/confirm", "reidentify")
    names = (*motions, "jobs", "ack", "accept", "rollback", "schedules", "maintenance")
    for name in names:
        answer = daemon.post(f"/arms/{ARM}/{name}", content=sent, headers=FORM)
        assert answer.status_code == 403, name
        assert complaints(answer.text) == []
    others = ("/jobs/j1/cancel", "/reidentifications/again/cancel", "/schedules/1/enabled", "/schedules/1/remove",
              "/due/1/dismiss", "/alarms/1/ack")  # fmt: skip
    for address in others:
        assert daemon.post(address, content=sent, headers=FORM).status_code == 403, address
    db = daemon.service.db
    assert (len(schedules(db)), len(pending(db)), len(alarms(db)), len(events(db, ARM))) == (3, 1, 1, 1)
    assert daemon.get("/new").status_code == 403
    assert list(arm_fault_store(daemon.service.state, ARM).latched()) == ["FOLLOWING_ERROR"]


@pytest.mark.parametrize(
    "headers",
    [{"Origin": "http://elsewhere.example"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}, {}],
    ids=["foreign", "null", "cross-site", "none"],
)
def test_a_form_of_another_page_does_nothing(daemon: Asked, headers: dict[str, str]) -> None:
    enter(daemon, "operator")
    sent = {"Content-Type": FORM["Content-Type"], **headers}
    answer = daemon.post(f"/arms/{ARM}/ack", content="code=FOLLOWING_ERROR", headers=sent)
    assert answer.status_code == 403
    assert list(arm_fault_store(daemon.service.state, ARM).latched()) == ["FOLLOWING_ERROR"]
    answer = daemon.post(f"/arms/{ARM}/ack", content="code=FOLLOWING_ERROR", headers=FORM)
    assert answer.status_code == 303
    assert not arm_fault_store(daemon.service.state, ARM).latched()


def test_a_motion_needs_the_typed_name_and_a_fresh_page(daemon: Asked) -> None:
    enter(daemon, "operator")
    arm_fault_store(daemon.service.state, ARM).acknowledge("FOLLOWING_ERROR")

    def challenge() -> str:
        answer = daemon.post(f"/arms/{ARM}/confirm", content="kind=check", headers=FORM)
        assert complaints(answer.text) == []
        found = re.search(r'name="challenge" value="([^"]+)"', answer.text)
        assert found is not None
        return found[1]

    word = challenge()
    for sent in (f"name=planar2&challenge={word}", f"name={ARM}&challenge={word}", f"name={ARM}&challenge=x"):
        answer = daemon.post(f"/arms/{ARM}/move", content=f"kind=check&{sent}", headers=FORM)
        assert (answer.status_code, "Nothing has moved" in answer.text) == (409, True)
        assert complaints(answer.text) == []
    assert not rows.jobs(daemon.service.db, arm=ARM, states=rows.LIVE)
    answer = daemon.post(f"/arms/{ARM}/move", content=f"kind=check&name={ARM}&challenge={challenge()}", headers=FORM)
    assert answer.status_code == 303
    where = answer.headers["location"]
    page = daemon.get(where)
    assert 'data-lease="keep"' in page.text
    assert complaints(page.text) == []
    # Whoever comes to the job by another way only looks, and so does another person.
    assert "data-lease" not in daemon.get(where.split("?")[0]).text
    enter(daemon, "viewer")
    assert "data-lease" not in daemon.get(where).text
    daemon.post("/stop", content="", headers=FORM)


def test_the_page_of_a_job_shows_what_a_terminal_would(daemon: Asked) -> None:
    enter(daemon, "viewer")
    job = daemon.service.engine.create(Base(kind="base", arm="planar2"), "test")["id"]
    daemon.follow(job)
    page = daemon.get(f"/jobs/{job}").text
    assert re.search(r'<pre class="answer"[^>]*>1  Lzz1 - 0.25\*\(m1 \+ m2\) \+ Ia1\n', page)
    assert "13 base parameters of 28 link parameters</pre>" in page
    assert complaints(page) == []


def test_a_run_is_requested_with_a_target(daemon: Asked) -> None:
    enter(daemon, "operator")
    arm_fault_store(daemon.service.state, ARM).acknowledge("FOLLOWING_ERROR")
    fields = [attrs for _, attrs in Reader(daemon.get(f"/arms/{ARM}").text).tags if attrs.get("name") == "until"]
    assert [one["type"] for one in fields] == ["number"]

    def confirmed(until: str) -> tuple[str, str]:
        answer = daemon.post(f"/arms/{ARM}/confirm", content=f"kind=run&speed=1&until={until}", headers=FORM)
        assert (answer.status_code, complaints(answer.text)) == (200, [])
        hidden = {attrs["name"]: attrs["value"] or "" for _, attrs in Reader(answer.text).tags if "value" in attrs}
        sent = urlencode({**hidden, "name": ARM})
        assert hidden["until"] == until
        return sent, answer.text

    for wrong in ("2", "0", "-1", "nan", "much"):
        answer = daemon.post(f"/arms/{ARM}/move", content=confirmed(wrong)[0], headers=FORM)
        assert answer.status_code in (400, 422), wrong
        assert complaints(answer.text) == []
    assert not rows.jobs(daemon.service.db, arm=ARM, states=rows.LIVE)
    sent, shown = confirmed("0.05")
    assert "0.05 of its parameter" in shown
    answer = daemon.post(f"/arms/{ARM}/move", content=sent, headers=FORM)
    assert answer.status_code == 303, answer.text
    job = rows.jobs(daemon.service.db, arm=ARM, most=1)[0]
    assert job["request"]["until"] == {"share": 0.05, "parameters": []}
    assert "--until=0.05" in job["words"]
    page = daemon.get(answer.headers["location"])
    assert complaints(page.text) == []
    assert 'data-until="0.05"' in page.text
    assert "Ends early" not in daemon.post(f"/arms/{ARM}/confirm", content="kind=run&speed=1", headers=FORM).text
    daemon.post("/stop", content="", headers=FORM)


def test_a_rehearsal_begins_on_its_own_page_only(daemon: Asked) -> None:
    enter(daemon, "operator")
    answer = daemon.post(f"/arms/{ARM}/confirm", content="kind=rehearse&speed=0.2", headers=FORM)
    assert (answer.status_code, complaints(answer.text)) == (200, [])
    assert 'id="hold"' in answer.text
    answer = daemon.post(f"/arms/{ARM}/move", content=f"kind=rehearse&name={ARM}", headers=FORM)
    assert (answer.status_code, "held" in answer.text) == (400, True)


def test_stop_needs_nobody_here_and_somebody_elsewhere(daemon: Asked) -> None:
    answer = daemon.post("/stop", headers={"Origin": URL})
    assert (answer.status_code, complaints(answer.text)) == (200, [])
    assert daemon.post("/stop", headers={"Origin": URL}, address="203.0.113.9").status_code == 303
    assert daemon.post("/stop", headers={"Origin": "http://elsewhere.example"}).status_code == 403
    enter(daemon, "viewer")
    assert daemon.post("/stop", headers={"Origin": URL}, address="203.0.113.9").status_code == 200


def test_a_set_that_was_accepted_elsewhere_has_no_link(daemon: Asked, commissioned: Path, tmp_path: Path) -> None:
    enter(daemon, "viewer")
    assert f'href="/runs/{commissioned.name}"' in daemon.get(f"/arms/{ARM}").text
    shutil.copytree(commissioned, tmp_path / "elsewhere")
    state = str(daemon.service.state)
    assert main(["accept", str(tmp_path / "elsewhere"), "--note", "x", "--by", "ann", "--state", state]) == 0
    for page in (f"/arms/{ARM}", f"/arms/{ARM}/parameters"):
        text = daemon.get(page).text
        assert "elsewhere" in text
        assert "/runs/elsewhere" not in text


def test_accepting_asks_for_the_name_and_mistakes_are_pages(daemon: Asked, commissioned: Path) -> None:
    enter(daemon, "operator")
    sent = f"run={commissioned.name}&note=again"
    answer = daemon.post(f"/arms/{ARM}/accept", content=f"{sent}&name=planar2", headers=FORM)
    assert (answer.status_code, complaints(answer.text)) == (400, [])
    assert len(daemon.get(f"/api/v1/arms/{ARM}/acceptances").json()) == 1
    answer = daemon.post(f"/arms/{ARM}/accept", content=f"{sent}&name={ARM}", headers=FORM)
    assert answer.status_code == 303
    assert len(daemon.get(f"/api/v1/arms/{ARM}/acceptances").json()) == 2
    for address in ("/arms/nobody", "/jobs/none", "/runs/none", "/runs/..%2f..", "/static/x/page.js", "/exports/j1/x"):
        answer = daemon.get(address)
        assert answer.status_code in (404, 422), address
        if "Not Found" not in answer.text[:40]:
            assert "<script>" not in answer.text
    for body in (b"\xff=\xff", b"&".join(b"a%d=b" % k for k in range(100))):
        answer = daemon.post("/new", content=body, headers=FORM)
        assert answer.status_code in (400, 422)
        assert complaints(answer.text) == []
    answer = daemon.post("/new", content="description=%3Cscript%3E", headers=FORM)
    assert answer.status_code == 422
    assert "<script>" not in answer.text


def test_two_runs_are_compared(daemon: Asked, commissioned: Path, tmp_path: Path) -> None:
    second = tmp_path / "second-run"
    shutil.copytree(commissioned, second)
    import_run(daemon.service.db, daemon.service.state, second, "test")
    enter(daemon, "viewer")
    answer = daemon.get(f"/compare?reference={commissioned.name}&other=second-run")
    assert answer.status_code == 200
    assert "unchanged" in answer.text
    assert str(daemon.service.state) not in answer.text
    assert daemon.get(f"/compare?reference={commissioned.name}&other={commissioned.name}").status_code == 400


def test_scripts_and_styles_are_ours_and_kept(daemon: Asked) -> None:
    for name in static_files():
        answer = daemon.get(f"/static/{static_version()}/{name}")
        assert (answer.status_code, answer.content) == (200, static_files()[name])
        assert "immutable" in answer.headers["cache-control"]
    for content in (static_files()[name] for name in STATIC):
        assert not re.search(rb"https?://(?!www\.w3\.org/2000/svg)", content)
        assert b"innerHTML" not in content


def test_the_list_says_what_an_arm_is_and_what_comes_next(daemon: Asked, commissioned: Path) -> None:
    enter(daemon, "viewer")
    cards = {
        name: text
        for text in daemon.get("/").text.split('<li class="card">')[1:]
        if (name := (re.search(r'<h3><a href="/arms/([^"]+)">', text) or [""])[1])
    }
    assert '<span class="state simulated">simulated</span>' in cards["planar2"]
    assert "real, canopen" in cards["wam7_canopen"]
    assert "recordings only" in cards["ur10"]
    assert "acknowledge the fault" in cards[ARM]
    assert f'href="/runs/{commissioned.name}"' in cards[ARM]
    assert f'src="/arms/{ARM}/picture.svg' in cards[ARM]
    answer = daemon.get(f"/arms/{ARM}/picture.svg")
    assert answer.headers["content-type"] == "image/svg+xml"
    assert answer.text.count("<polygon") >= 3  # base and two links
    assert "script" not in answer.text
    assert answer.headers["content-security-policy"].startswith("default-src 'none'")


def test_an_arm_whose_control_file_cannot_be_opened_says_what_to_do(daemon: Asked) -> None:
    """One such arm does not keep the list from showing the others."""
    enter(daemon, "viewer")
    assert daemon.get("/api/v1/arms/threelink").json()["control_problem"] is None
    path = control_path(daemon.service.state, "threelink")
    path.parent.mkdir(parents=True)
    path.symlink_to(path)  # nobody can open it
    problem = daemon.get("/api/v1/arms/threelink").json()["control_problem"]
    assert problem.startswith("arms/threelink/control: cannot be opened: Too many levels of symbolic")
    assert problem.endswith("; then make it a file that the account running ident can read and write")
    for address in ("/", "/arms/threelink"):
        answer = daemon.get(address)
        assert (answer.status_code, complaints(answer.text)) == (200, [])
        assert answer.text.count(f"{problem}.</p>") == 1, address
    assert daemon.get("/api/v1/arms/threelink").json()["faults"] is None
    assert daemon.get("/api/v1/arms/threelink/faults").status_code == 409  # not an empty list
    enter(daemon, "operator")
    assert "Watch it for a minute" not in daemon.get("/arms/threelink").text
    assert "Watch it for a minute" in daemon.get("/arms/planar2").text
    assert 'href="/arms/planar2"' in daemon.get("/").text
    assert 'ident_arm_moving{arm="threelink"} 1.0' in daemon.get("/metrics").text


def test_an_unknown_page_is_one_of_ours_in_a_browser(daemon: Asked) -> None:
    browser = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}
    for role in (None, "viewer"):
        if role:
            enter(daemon, role)
        answer = daemon.get("/no<script>page", headers=browser)
        assert answer.status_code == 404
        assert complaints(answer.text) == []
        assert "There is no page /no&lt;script&gt;page here." in answer.text
        assert '<a href="/">the arms</a>' in answer.text
        assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert daemon.get("/nopage").json()["error"]["kind"] == "NotFound"  # what a program asks
    assert daemon.get("/api/v1/nothing", headers=browser).json()["error"]["kind"] == "NotFound"


def test_an_arm_with_recordings_only_begins_at_identify(daemon: Asked) -> None:
    enter(daemon, "operator")
    page = daemon.get("/arms/ur10").text
    steps = re.findall(r'<li class="step (\w+)" id="step-(\w+)"', page)
    assert steps == [
        ("done", "description"), ("next", "identify"), ("open", "report"), ("open", "accept"), ("open", "export"),
    ]  # fmt: skip
    assert 'value="home"' not in page
    assert "State at rest" not in page
    assert "State at rest" in daemon.get("/arms/planar2").text


def test_a_motion_is_confirmed_knowing_its_length_speed_and_reach(daemon: Asked) -> None:
    enter(daemon, "operator")
    arm_fault_store(daemon.service.state, ARM).acknowledge("FOLLOWING_ERROR")

    def shown(kind: str, speed: float) -> str:
        answer = daemon.post(f"/arms/{ARM}/confirm", content=f"kind={kind}&speed={speed}", headers=FORM)
        assert (answer.status_code, complaints(answer.text)) == (200, [])
        return re.sub(r"<[^>]+>|\s+", " ", answer.text)

    # Four periods of five seconds; two links of half a metre, with bodies around them.
    assert re.search(r"Length\s+20 s, and \d s from home", shown("run", 1.0))
    assert re.search(r"Length\s+40 s", shown("run", 0.5))
    assert re.search(r"Reach\s+joints, links and described bodies come up to 1 m from", shown("rehearse", 0.2))
    whole, half = (re.search(r"moves at up to ([\d.]+) m/s", shown("run", speed)) for speed in (1.0, 0.5))
    assert whole is not None
    assert half is not None
    assert float(half[1]) == pytest.approx(0.5 * float(whole[1]), rel=0.1)
    assert "shoulder" in shown("run", 1.0)
    picture = daemon.get(f"/arms/{ARM}/motion.svg")
    assert "side view" in picture.text
    assert "top view" in picture.text


def test_parameters_are_shown_the_least_certain_first() -> None:
    numbers = [("a", 1.0, 0.5, "weak"), ("b", 0.0, None, "unidentified"), ("c", 5.0, 4.0, "unidentified")]
    numbers += [("d", -2.0, 0.2, "identified"), ("e", 0.0, 0.0, "identified"), ("f", 1e-6, 1e-6, "identified")]
    names, values, deviations, verdicts = zip(*numbers, strict=True)
    found = IdentifiedSet("use", "", (), (), (), names, ("",) * 6, values, deviations, verdicts)
    assert [row[0] for row in found.rows] == ["b", "c", "a", "f", "d", "e"]


def test_the_table_of_runs_is_searched_beyond_its_first_page(daemon: Asked) -> None:
    db = daemon.service.db
    for number in range(450):
        db.write(
            "INSERT INTO runs VALUES (?, 'motion', ?, NULL, ?, 'done', NULL, 0.0, NULL)",
            *(f"r{number}", ("a", "b")[number % 2], float(number)),
        )
    db.write("INSERT INTO run_labels VALUES ('r7', ?, 'before the oil change', 0.0, 'me')", json.dumps(["cold"]))
    enter(daemon, "viewer")
    for query in ("tag=cold", "text=OIL", "tag=cold&kind=motion&arm=b"):
        page = daemon.get(f"/runs?{query}").text
        assert re.findall(r'href="/runs/(r\d+)"', page) == ["r7"], query
        assert "Earlier runs" not in page
    page, seen = daemon.get("/runs?kind=motion&text=r").text, list[str]()
    assert "<option>cold</option>" in page
    assert "<option selected>warm</option>" in daemon.get("/runs?tag=warm").text  # which no run has
    answer = daemon.get(f"/runs?tag={'x' * 41}")
    assert answer.status_code == 422
    assert ">tag: must have at most 40 characters, not 41</p>" in answer.text
    while True:
        seen += re.findall(r'href="/runs/(r\d+)"', page)
        if (earlier := re.search(r'href="(/runs\?[^"]*before=[^"]*)"', page)) is None:
            break
        assert "kind=motion" in earlier[1]
        page = daemon.get(unescape(earlier[1])).text
    assert seen == [f"r{number}" for number in reversed(range(450))]


def test_a_run_gets_tags_and_a_note(daemon: Asked, commissioned: Path) -> None:
    enter(daemon, "operator")
    where = f"/runs/{commissioned.name}"
    answer = daemon.post(f"{where}/labels", content="tags=warm,+belt+warm&note=after+lunch", headers=FORM)
    assert (answer.status_code, answer.headers["location"]) == (303, f"{where}#labels")
    line = next(one for one in daemon.get("/api/v1/runs").json() if one["id"] == commissioned.name)
    assert (line["tags"], line["note"]) == (["warm", "belt"], "after lunch")
    assert "after lunch" in daemon.get("/runs?tag=warm").text
    assert "after lunch" in daemon.get("/runs?text=LUNCH").text
    assert "after lunch" not in daemon.get("/runs?tag=cold").text
    for bad in ("tags=<b>", f"note={'x' * 2001}", f"tags={'+'.join(f't{k}' for k in range(17))}"):
        answer = daemon.post(f"{where}/labels", content=bad, headers=FORM)
        assert (answer.status_code, complaints(answer.text)) == (400, []), bad
    assert daemon.get(f"/api/v1{where}").json()["tags"] == ["warm", "belt"]
    answer = daemon.post("/runs/none/labels", content="tags=a", headers=FORM)
    assert answer.status_code == 404


def test_a_recording_is_thinned_for_display(daemon: Asked, commissioned: Path) -> None:
    enter(daemon, "viewer")
    answer = daemon.get(f"/api/v1/runs/{commissioned.name}/series?name=identification.mcap")
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert told["joints"] == ["shoulder", "elbow"]
    assert 200 < len(told["time"]) <= 1500
    assert told["time"] == sorted(set(told["time"]))
    recording = open_recording(commissioned / "identification.mcap")
    blocks = list(recording.blocks())
    position = np.concatenate([block.position for block in blocks])
    stamps = np.concatenate([block.stamp_ns for block in blocks])
    at = np.interp(told["time"], (stamps - stamps[0]) * 1e-9, position[:, 1])
    np.testing.assert_allclose(told["position"][1], at, atol=2e-4)
    assert np.abs(told["error"][0]).max() > np.abs(np.subtract(told["reference"][0], told["position"][0])).max() - 1e-6
    states = [one["message"] for one in told["events"] if one["kind"] == "state"]
    assert states[-1] == "done"
    assert told["begins"] > 0.0
    assert daemon.get(f"/api/v1/runs/{commissioned.name}/series?name=arm.json").status_code in (400, 422)
    assert daemon.get(f"/api/v1/runs/{commissioned.name}/series?name=none.mcap").status_code == 404


def test_parameters_are_trended_against_the_accepted_set(daemon: Asked, commissioned: Path, tmp_path: Path) -> None:
    second = tmp_path / "later-run"
    shutil.copytree(commissioned, second)
    document = json.loads((second / "parameters.json").read_text())
    table = document["base_parameters"]
    place = table["expressions"].index("fc2")
    table["values"][place] += 10.0 * table["standard_deviations"][place]
    (second / "parameters.json").write_text(json.dumps(document))
    write_manifest(second)
    import_run(daemon.service.db, daemon.service.state, second, "test")
    enter(daemon, "viewer")
    page = daemon.get(f"/arms/{ARM}/parameters").text
    first = page.split("<tbody>")[1].split("</tr>")[0]
    assert ">fc2</th>" in first  # the largest change comes first
    sigma = re.findall(r'data-value="([\d.]+)"', first)[-1]
    assert float(sigma) == pytest.approx(10.0 / np.sqrt(2.0), rel=1e-6)
    shown = daemon.get(f"/runs?arm={ARM}&parameter=fc2").text
    assert shown.count(" ± ") == 2
