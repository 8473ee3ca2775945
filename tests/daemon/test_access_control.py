"""Every door of the service that must stay shut, tried."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import httpx
import pytest
from daemon.conftest import URL, Asked, serving

from ident_service.config.load import shipped_arms
from ident_service.daemon.authentication import CHALLENGE_SECONDS, SESSION_SECONDS, Authenticator, Throttle, Throttled
from ident_service.daemon.request_guard import MOST_BODY, MOST_UPLOAD
from ident_service.daemon.settings import Settings
from ident_service.errors import UsageError
from ident_service.motion.command_channel import ControlFile
from ident_service.registry.database import Database, audit_log
from ident_service.registry.state_folder import control_path
from ident_service.registry.tokens import add_token, revoke_token

OPEN = {("GET", "/healthz"), ("POST", "/api/v1/login"), ("POST", "/api/v1/logout")}
STOPS = {("POST", "/api/v1/stop"), ("POST", "/api/v1/arms/{arm}/stop")}
FILLED = {
    "arm": "planar2",
    "job": "j",
    "run": "r",
    "motion": "m",
    "name": "n",
    "code": "c",
    "number": 1,
    "export": "e",
    "token": "t",
    "upload": "u",
    "sha256": 16 * "0",
    "joint": 0,
}
MOTION = {"kind": "run", "arm": "planar2"}
FAR = "203.0.113.9"


def routes(daemon: Asked) -> list[tuple[str, str]]:
    """Method and path of every operation of the description."""
    document = daemon.get("/api/v1/openapi.json").json()
    return [(method.upper(), path) for path, item in document["paths"].items() for method in item]


def refusal(answer: httpx.Response, status: int, words: str = "") -> None:
    """The answer is a refusal of the one shape."""
    assert answer.status_code == status, answer.text
    document = answer.json()
    assert set(document) == {"error"}
    assert set(document["error"]) == {"kind", "message"}
    assert re.search(words, document["error"]["message"]), document


@pytest.mark.slow
def test_nothing_answers_without_a_token_but_health_and_stop(daemon: Asked) -> None:
    tried = 0
    daemon.headers.clear()
    for method, path in routes(daemon):
        if (method, path) in OPEN | STOPS:
            continue
        tried += 1
        answer = daemon.ask(method, path.format(**FILLED), json={})
        refusal(answer, 401)
        assert answer.headers["www-authenticate"] == "Bearer"
    assert tried > 20


@pytest.mark.parametrize("secret", ["", "x", "ident_", "ident_" + "A" * 43, "\xff"])
def test_a_token_that_is_nobodys_opens_nothing(daemon: Asked, secret: str) -> None:
    refusal(daemon.get("/api/v1/arms", headers={"Authorization": f"Bearer {secret}".encode("latin-1")}), 401)


@pytest.mark.slow
def test_a_viewer_changes_nothing(daemon: Asked, viewer: str) -> None:
    daemon.as_token(viewer)
    bodies = {
        "/api/v1/arms": {"description": "x"},
        "/api/v1/motions": {"arm": "planar2", "motion": "{}"},
        "/api/v1/jobs": {"job": {"kind": "simulate", "arm": "planar2"}},
        "/api/v1/arms/{arm}/acceptances": {"run": "r", "note": "n"},
        "/api/v1/arms/{arm}/rollback": {"note": "n"},
        "/api/v1/schedules": {"arm": "planar2", "maintenance": True},
        "/api/v1/schedules/{number}/enabled": {"enabled": False},
        "/api/v1/arms/{arm}/maintenance": {"what": "belt"},
        "/api/v1/due/{number}/dismiss": {"note": "n"},
        "/api/v1/reidentifications": {"arm": "planar2"},
        "/api/v1/alarms/{number}/ack": {"note": "n"},
        "/api/v1/descriptions/check": {"description": "x"},
        "/api/v1/recordings/prune": {"keep": 1},
        "/api/v1/uploads": {"arm": "planar2", "name": "x.csv", "bytes": 1, "sha256": 64 * "0"},
    }
    tried = 0
    for method, path in routes(daemon):
        if method == "GET" or (method, path) in OPEN | STOPS:
            continue
        tried += 1
        refusal(daemon.ask(method, path.format(**FILLED), json=bodies.get(path)), 403, "operator")
    assert tried >= 10
    assert daemon.get("/api/v1/arms").status_code == 200
    assert daemon.get("/api/v1/jobs").json() == []


def test_a_revoked_token_and_its_session_count_no_more(daemon: Asked) -> None:
    db = daemon.service.db
    secret = add_token(db, "ann", "operator", "test")
    daemon.headers.clear()
    answer = daemon.post("/api/v1/login", {"token": secret})
    cookie = answer.cookies["ident_session"]
    header = {"Cookie": f"ident_session={cookie}"}
    assert daemon.get("/api/v1/whoami", headers=header).json() == {"name": "ann", "role": "operator"}
    revoke_token(db, "ann", "test")
    refusal(daemon.get("/api/v1/whoami", headers=header), 401)
    refusal(daemon.post("/api/v1/login", {"token": secret}), 401)


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "", "localhost@evil.example", "127.0.0.1:x"]
)
def test_another_host_is_not_ours(daemon: Asked, host: str) -> None:
    refusal(daemon.get("/healthz", headers={"Host": host}), 421)
    refusal(daemon.post("/api/v1/stop", headers={"Host": host}), 421)


@pytest.mark.parametrize("host", ["127.0.0.1:8470", "localhost", "LOCALHOST:1", "[::1]:8470"])
def test_our_own_names_are(daemon: Asked, host: str) -> None:
    assert daemon.get("/healthz", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:8470", "http://127.0.0.1:8471"])
def test_a_page_of_another_origin_asks_nothing_of_us(daemon: Asked, origin: str) -> None:
    for path in ("/api/v1/jobs", "/api/v1/stop", "/api/v1/login"):
        refusal(daemon.post(path, {}, headers={"Origin": origin}), 403)
    refusal(daemon.post("/api/v1/stop", headers={"Sec-Fetch-Site": "cross-site"}), 403)
    assert daemon.post("/api/v1/stop", headers={"Origin": URL, "Sec-Fetch-Site": "same-origin"}).status_code == 200


def test_a_session_alone_changes_nothing_without_its_page(daemon: Asked) -> None:
    secret = daemon.headers.pop("Authorization").removeprefix("Bearer ")
    answer = daemon.post("/api/v1/login", {"token": secret})
    flags = answer.headers["set-cookie"].lower()
    assert "httponly" in flags
    assert "samesite=strict" in flags
    header = {"Cookie": f"ident_session={answer.cookies['ident_session']}"}
    assert daemon.get("/api/v1/arms", headers=header).status_code == 200
    path = "/api/v1/arms/planar2/challenge"
    refusal(daemon.post(path, headers=header), 403)
    assert daemon.post(path, headers={**header, "Origin": URL}).status_code == 201
    daemon.post("/api/v1/logout", headers={**header, "Origin": URL})
    refusal(daemon.get("/api/v1/arms", headers=header), 401)


def test_failed_logins_are_throttled_and_stop_is_not(daemon: Asked) -> None:
    good = dict(daemon.headers)
    other = add_token(daemon.service.db, "late", "operator", "test")
    assert daemon.get("/api/v1/arms").status_code == 200  # from here this token is known
    daemon.headers.clear()
    codes = [daemon.post("/api/v1/login", {"token": f"wrong{k}"}).status_code for k in range(12)]
    assert codes == [401] * 10 + [429] * 2
    # Even a good one that was never seen from here is not heard: guesses are not told from it.
    answer = daemon.post("/api/v1/login", {"token": other})
    refusal(answer, 429)
    assert 0 < int(answer.headers["retry-after"]) <= 60
    assert daemon.get("/api/v1/arms", headers=good).status_code == 200
    assert daemon.post("/api/v1/stop").status_code == 200
    assert daemon.post("/api/v1/login", {"token": other}, address="198.51.100.7").status_code == 200


def test_the_throttle_counts_each_address_and_each_token() -> None:
    now = [0.0]
    throttle = Throttle(lambda: now[0])
    for k in range(10):
        throttle.require("10.0.0.1", f"token {k}")
        throttle.failed("10.0.0.1", f"token {k}")
        now[0] += 1.0
        throttle.require(f"10.0.1.{k}", "revoked")
        throttle.failed(f"10.0.1.{k}", "revoked")
    for keys in (("10.0.0.1", "good"), ("10.0.0.2", "revoked")):
        with pytest.raises(Throttled) as caught:
            throttle.require(*keys)
        assert 50.0 <= caught.value.seconds <= 60.0
    throttle.require("10.0.0.2", "good")
    now[0] = 60.1
    throttle.require("10.0.0.1", "good")


def test_failures_elsewhere_lock_out_nobody(daemon: Asked) -> None:
    good = add_token(daemon.service.db, "late", "operator", "test")
    daemon.headers.clear()
    codes = [
        daemon.post("/api/v1/login", {"token": f"wrong{k}"}, address=f"198.51.100.{k % 11}").status_code
        for k in range(110)
    ]
    assert codes == [401] * 110
    assert daemon.post("/api/v1/login", {"token": good}, address="203.0.113.1").status_code == 200


@pytest.mark.parametrize(
    ("path", "most"),
    [
        ("/api/v1/jobs", MOST_BODY),
        ("/api/v1/recordings/prune", MOST_BODY),
        ("/api/v1/arms", MOST_UPLOAD),
        ("/api/v1/descriptions/check", MOST_UPLOAD),
    ],
)
def test_a_body_is_counted_as_it_comes(daemon: Asked, path: str, most: int) -> None:
    def pieces() -> object:
        sent = 0

        async def stream() -> object:
            nonlocal sent
            while sent <= most:
                sent += 65_536
                yield b" " * 65_536

        return stream()

    # Without a Content-Length, and with one that is not true.
    refusal(daemon.ask("POST", path, content=pieces()), 413, str(most))
    refusal(daemon.ask("POST", path, content=pieces(), headers={"Content-Length": "10"}), 413)


@pytest.mark.parametrize(
    "word",
    ["..", "../token", "..%2f..%2ftoken", "%2e%2e%2ftoken", "/etc/passwd", "a/b", "a\\..\\b", ".hid", "a%00b"],
)
def test_no_id_is_a_path(daemon: Asked, word: str) -> None:
    places = ("runs/{}", "runs/{}/files/arm.json", "runs/x/files/{}", "jobs/{}/log", "motions/{}", "arms/{}")
    for place in (*places, "exports/{}", "exports/{}/files/n", "exports/x/files/{}", "arms/{}/home"):
        answer = daemon.get("/api/v1/" + place.format(word))
        assert answer.status_code in (404, 422), (place, answer.text)
        assert "ident_" not in answer.text.replace("ident_session", "")
    jobs: list[dict[str, object]] = [
        *({"kind": kind, "run": word} for kind in ("report", "feasible", "correct", "figures", "verify")),
        *({"kind": kind, "arm": word} for kind in ("bus_load", "bus_scan", "bus_probe", "config_check")),
        {"kind": "identify", "arm": "planar2", "recordings": [{"run": word}]},
        {"kind": "payload", "run": "r", "recordings": [{"run": "r", "name": word}]},
        {"kind": "feasible", "run": "r", "arm": word},
    ]
    for job in jobs:
        assert daemon.post("/api/v1/jobs", {"job": job}).status_code in (404, 422)


@pytest.mark.parametrize("reach", ["/etc/passwd", "../../token", "../../registry.sqlite", "../../../outside.urdf"])
@pytest.mark.parametrize("door", ["arms", "descriptions/check"])
def test_an_upload_leads_nowhere(daemon: Asked, state: Path, reach: str, door: str) -> None:
    (state.parent / "outside.urdf").write_text("<robot name='outside'/>")
    for text in (
        f"format: ident-arm\nversion: 1\nname: spy\nkinematics: {{urdf: {reach}}}\n",
        f"extends: {reach}\nname: spy\n",
        f"format: ident-arm\nversion: 1\nname: spy\nkinematics: {{urdf: own.urdf}}\nprior: {reach}\n",
    ):
        answer = daemon.post(f"/api/v1/{door}", {"description": text, "files": {"own.urdf": "<robot name='x'/>"}})
        refusal(answer, 422, "leads out of the upload|extends a shipped arm|extends: an uploaded")
        assert "root:" not in answer.text
        assert str(state) not in answer.text
    assert not any(row["name"] == "spy" for row in daemon.get("/api/v1/arms").json())


@pytest.mark.parametrize("door", ["arms", "descriptions/check"])
def test_an_upload_learns_nothing_of_other_files(daemon: Asked, state: Path, door: str) -> None:
    def answer(key: str, value: str) -> str:
        text = f"format: ident-arm\nversion: 1\nname: spy\n{key.format(json.dumps(value))}\n"
        told = daemon.post(f"/api/v1/{door}", {"description": text, "files": {"own.urdf": "<robot name='x'/>"}})
        assert str(state) not in told.text
        return f"{told.status_code} {told.text.replace(value, 'FILE')}"

    (state / "descriptions").mkdir(exist_ok=True)
    for key in (
        "kinematics: {{urdf: {}}}",
        "kinematics: {{urdf: own.urdf}}\nprior: {}",
        "description: {}",
        "gravity: {}",
    ):
        # A text is a text, and a file that is there is told from one that is not by nobody.
        for there, not_there in (("/etc/shadow", "/etc/shadov"), ("../../token", "../../tokem"), ("..", "...")):
            assert answer(key, there) == answer(key, not_there), key
        if "description" in key:
            assert "FILE" not in answer(key, "/etc/shadow")
    assert "no such file: xxx" in answer("kinematics: {{urdf: {}}}", "x" * 300)


@pytest.mark.parametrize("door", ["arms", "descriptions/check"])
def test_an_upload_names_no_code(daemon: Asked, state: Path, door: str) -> None:
    # Were it imported, it would leave a trace, wherever it was looked for.
    trace = state.parent / "imported"
    text = "extends: planar2\nname: spy\nconstraints: {custom: spying:spied}\n"
    files = {"spying.py": f"open({str(trace)!r}, 'w')\ndef spied(link, base): return []\n"}
    answer = daemon.post(f"/api/v1/{door}", {"description": text, "files": files})
    refusal(answer, 422, "3:15: constraints.custom: a description that is sent names no code")
    assert not any(row["name"] == "spy" for row in daemon.get("/api/v1/arms").json())
    assert not trace.exists()


def test_a_file_of_an_upload_is_not_taken_for_a_shipped_arm(daemon: Asked, state: Path) -> None:
    secret = state.parent / "secret.urdf"
    secret.write_text("<robot name='secret'/>")
    files = {"planar2": f"extends: {secret}\n"}
    refusal(
        daemon.post("/api/v1/arms", {"description": "extends: planar2\nname: spy\n", "files": files}), 400, "shipped"
    )


@pytest.mark.parametrize("name", ["../x", "arm.yaml", "a/b", "", ".x", "a" * 200])
def test_an_uploaded_file_has_a_plain_name(daemon: Asked, name: str) -> None:
    text = shipped_arms()["planar2"].read_text()
    assert daemon.post("/api/v1/arms", {"description": text, "files": {name: "x"}}).status_code in (400, 422)


def test_a_motion_needs_the_typed_name_and_a_fresh_challenge(daemon: Asked, viewer: str) -> None:
    def asked(confirm: object) -> httpx.Response:
        return daemon.post("/api/v1/jobs", {"job": MOTION, "confirm": confirm})

    for kind in ("check", "rehearse", "run", "home", "leave_limit", "zero"):
        refusal(daemon.post("/api/v1/jobs", {"job": {"kind": kind, "arm": "planar2"}}), 409, "challenge")
    refusal(asked({"name": "planar2", "challenge": ""}), 409)
    refusal(asked({"name": "planar2", "challenge": "made up"}), 409)
    refusal(asked({"name": "planar2", "challenge": daemon.challenge("sixaxis")}), 409)
    word = daemon.challenge("planar2")
    refusal(
        asked({"name": "Planar2", "challenge": word}),
        409,
        "planar2: the typed name 'Planar2' is not this arm's; nothing",
    )
    refusal(asked({"name": "planar2", "challenge": word}), 409)  # the wrong name has used it up
    word = daemon.challenge("planar2")
    owner = dict(daemon.headers)
    daemon.as_token(add_token(daemon.service.db, "other", "operator", "test"))
    refusal(asked({"name": "planar2", "challenge": word}), 409)  # given to somebody else
    daemon.headers.update(owner)
    assert daemon.get("/api/v1/jobs").json() == []


@pytest.mark.slow
def test_a_request_that_comes_twice_moves_the_arm_once(daemon: Asked) -> None:
    body = {"job": MOTION, "confirm": {"name": "planar2", "challenge": daemon.challenge("planar2")}}
    assert daemon.post("/api/v1/jobs", body).status_code == 201
    refusal(daemon.post("/api/v1/jobs", body), 409, "used once")
    assert len(daemon.get("/api/v1/jobs").json()) == 1
    daemon.post("/api/v1/stop")


def test_a_challenge_does_not_count_for_long(tmp_path: Path) -> None:
    now = [0.0]
    with Database(tmp_path) as db:
        authenticator = Authenticator(db, lambda: now[0])
        word = authenticator.challenge("a", "me")
        now[0] = CHALLENGE_SECONDS - 0.1
        assert authenticator.confirm(word, "a", "me")
        assert not authenticator.confirm(word, "a", "me")
        word = authenticator.challenge("a", "me")
        now[0] += CHALLENGE_SECONDS + 0.1
        assert not authenticator.confirm(word, "a", "me")


def test_a_session_survives_a_restart_and_ends_in_time(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(state) as daemon:
        secret = daemon.headers.pop("Authorization").removeprefix("Bearer ")
        word = daemon.post("/api/v1/login", {"token": secret}).cookies["ident_session"]
        gone = daemon.post("/api/v1/login", {"token": secret}).cookies["ident_session"]
        daemon.post("/api/v1/logout", headers={"Cookie": f"ident_session={gone}", "Origin": URL})
    assert word not in "".join(path.read_text("latin-1") for path in state.glob("registry.sqlite*"))
    with serving(state) as daemon:
        daemon.headers.clear()
        header = {"Cookie": f"ident_session={word}"}
        assert daemon.get("/api/v1/whoami", headers=header).json()["name"] == "owner"
        refusal(daemon.get("/api/v1/whoami", headers={"Cookie": f"ident_session={gone}"}), 401)
        revoke_token(daemon.service.db, "owner", "test")
        refusal(daemon.get("/api/v1/whoami", headers=header), 401)
    with Database(state) as db:
        other = add_token(db, "late", "viewer", "test")
        authenticator = Authenticator(db)
        session = authenticator.log_in(other, "here")
        assert session is not None
        now = time.time()
        monkeypatch.setattr(time, "time", lambda: now + SESSION_SECONDS + 1.0)
        assert authenticator.by_session(session[0]) is None
        assert authenticator.known(None, session[0]) is None


@pytest.mark.slow
def test_stop_needs_no_token_here_and_any_token_from_elsewhere(daemon: Asked, viewer: str, state: Path) -> None:
    with ControlFile.take(control_path(state, "planar2"), None) as mover:
        daemon.headers.clear()
        refusal(daemon.post("/api/v1/stop", address=FAR), 401)
        refusal(daemon.post("/api/v1/stop", headers={"Authorization": "Bearer wrong"}, address=FAR), 401)
        assert not mover.stop
        answer = daemon.post("/api/v1/arms/planar2/stop", headers={"Authorization": f"Bearer {viewer}"}, address=FAR)
        assert answer.json() == {"arms": ["planar2"], "jobs": []}
        assert mover.stop
    with ControlFile.take(control_path(state, "planar2"), None) as mover:
        # A token that counts no more keeps nobody from a stop on the arm's own machine.
        assert daemon.post("/api/v1/stop", headers={"Authorization": "Bearer wrong"}).json()["arms"] == ["planar2"]
        assert mover.stop
    assert daemon.service.engine.audit.flush(10.0)
    assert {line["who"] for line in audit_log(daemon.service.db) if line["what"] == "stop"} == {"looks", "anybody"}


@pytest.mark.slow
def test_only_the_holder_renews_a_lease(daemon: Asked) -> None:
    job = daemon.begin(MOTION, confirmed=True)
    daemon.as_token(add_token(daemon.service.db, "other", "operator", "test"))
    refusal(daemon.post(f"/api/v1/jobs/{job['id']}/lease"), 403, "only the requester")
    daemon.post("/api/v1/stop")


@pytest.mark.slow
def test_no_answer_names_a_place_or_lets_itself_be_framed_or_kept(daemon: Asked, state: Path) -> None:
    job = daemon.begin({"kind": "simulate", "arm": "wam7"})  # not a simulated arm
    ended = daemon.follow(job["id"])
    assert ended["state"] == "failed"
    assert "no simulated driver" in ended["detail"]
    for path in (f"jobs/{job['id']}", f"jobs/{job['id']}/result", "jobs", "arms/planar2", "audit"):
        answer = daemon.get(f"/api/v1/{path}")
        assert answer.status_code == 200
        assert str(state) not in answer.text
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "robot.example"])  # noqa: S104 - refused
def test_a_network_is_not_served_without_tls(tmp_path: Path, host: str) -> None:
    with pytest.raises(UsageError, match="--tls-cert"):
        Settings(tmp_path, host=host)
    (tmp_path / "cert").touch()
    with pytest.raises(UsageError, match="both"):
        Settings(tmp_path, host=host, tls_cert=tmp_path / "cert")


def test_from_a_network_no_loopback_name_counts(state: Path) -> None:
    (state.parent / "pem").touch()
    pem = state.parent / "pem"
    with serving(state, host="0.0.0.0", tls_cert=pem, tls_key=pem, names=("robot.example",)) as daemon:  # noqa: S104
        refusal(daemon.get("/healthz"), 421)
        answer = daemon.get("/healthz", headers={"Host": "robot.example:8470"})
        assert answer.status_code == 200
        assert "strict-transport-security" in answer.headers
        # And nobody stops without a token there, whatever address a proxy has.
        daemon.headers.clear()
        refusal(daemon.post("/api/v1/stop", headers={"Host": "robot.example"}), 401)
