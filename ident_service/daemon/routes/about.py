"""Serve the routes about the service itself: health, metrics, identity, sessions of the page, tokens, audit trail.

Tokens are not made over HTTP: whoever got hold of an operator's token could make others, which would outlive its
revocation. Making one is an act at the state folder (`ident tokens add`). Revoking over HTTP is safe: it cannot lock
out a person at the state folder.
"""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Literal

from fastapi import APIRouter, Path, Request, Response
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel, Field

from ident_service import __version__
from ident_service.daemon.authentication import SESSION_SECONDS, Throttled
from ident_service.daemon.dependencies import COOKIE, Cookie, Operator, Serving, Viewer, address_of, throttled, unknown
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.jobs.requests import RequestBody
from ident_service.daemon.responses import PAGES, AuditLine, BeforeNumber, HealthAnswer, Most, Page, WhoAnswer
from ident_service.errors import IdentError
from ident_service.operations.drift_alarms import alarms
from ident_service.operations.maintenance_schedule import pending
from ident_service.registry.database import audit_log
from ident_service.registry.state_folder import arm_fault_store, known_arms
from ident_service.registry.tokens import revoke_token, tokens

router = APIRouter(tags=["service"], responses=failures(), generate_unique_id_function=operation_id)
AUDIT_SECONDS = 1.0  # s that a reader of the trail waits for queued lines
TokenName = Annotated[str, Path(pattern=r"^[a-z0-9][a-z0-9_.-]{0,39}$")]


class Login(RequestBody):
    """Token to be exchanged for a session of the page."""

    token: Annotated[str, Field(min_length=1, max_length=200)]


class TokenLine(BaseModel):
    """Access token; `revoked` is when it was revoked, null while it is valid. The token itself is stored nowhere."""

    name: str
    role: Literal["viewer", "operator"]
    created: float
    revoked: float | None


@router.get(
    "/healthz", responses={503: {"model": HealthAnswer, "description": "Queue or schedule is not looked after."}}
)
def healthz(service: Serving, response: Response) -> HealthAnswer:
    """Answer 200 if queue and schedule are looked after, 503 if not or while closing; needs no token."""
    healthy = service.engine.healthy and service.scheduler.healthy and not service.engine.closing
    response.status_code = 200 if healthy else 503
    return HealthAnswer(healthy=healthy, version=__version__)


@router.get("/metrics", response_class=PlainTextResponse, responses=failures())
def metrics(service: Serving, _: Viewer) -> PlainTextResponse:
    """Return the metrics of the service in Prometheus' text format."""
    rows = service.db.rows("SELECT kind, state, COUNT(*) AS number FROM jobs GROUP BY kind, state")
    faults = dict[str, int]()
    for arm in known_arms(service.state):
        try:
            faults[arm] = len(arm_fault_store(service.state, arm).latched())
        except IdentError:
            faults[arm] = 1  # a damaged file prevents motion like a fault
    jobs = {(row["kind"], row["state"]): row["number"] for row in rows}
    due = Counter[str](row["arm"] for row in pending(service.db))
    drifted = Counter[str](row["arm"] for row in alarms(service.db, most=10_000))
    text = service.metrics.text(jobs, service.engine.moving(), faults, due, drifted)
    return PlainTextResponse(text, media_type="text/plain; version=0.0.4")


@router.get("/api/v1/whoami")
def whoami(who: Viewer) -> WhoAnswer:
    """Return name and role of the token or session that asks."""
    return WhoAnswer(name=who.name, role=who.role)


@router.post("/api/v1/login")
def login(service: Serving, request: Request, response: Response, body: Login) -> WhoAnswer:
    """Exchange a token for a session; its cookie cannot be read by scripts and is sent by no other site."""
    try:
        found = service.authenticator.log_in(body.token, address_of(request))
    except Throttled as error:
        raise throttled(error) from None
    if found is None:
        raise unknown()
    session, who = found
    response.set_cookie(
        *(COOKIE, session),
        max_age=int(SESSION_SECONDS),
        path="/",
        secure=service.settings.tls,
        httponly=True,
        samesite="strict",
    )
    return WhoAnswer(name=who.name, role=who.role)


@router.post("/api/v1/logout", status_code=204)
def logout(service: Serving, response: Response, cookie: Cookie = None) -> None:
    """End the session of the page."""
    if cookie is not None:
        service.authenticator.log_out(cookie)
    response.delete_cookie(COOKIE, path="/", httponly=True, samesite="strict")


@router.get("/api/v1/audit", responses=PAGES)
def audit(page: Page, service: Serving, _: Viewer, before: BeforeNumber = None, most: Most = 100) -> list[AuditLine]:
    """List the lines of the audit trail, the newest first."""
    service.engine.audit.flush(AUDIT_SECONDS)
    return [AuditLine(**row) for row in page(most, lambda n: audit_log(service.db, before_id=before, max_lines=n))]


@router.get("/api/v1/tokens")
def list_tokens(service: Serving, _: Operator) -> list[TokenLine]:
    """List all tokens that were ever made, the earliest first."""
    return [TokenLine(**row) for row in tokens(service.db)]


@router.post("/api/v1/tokens/{token}/revoke", responses=failures(404))
def revoke(service: Serving, who: Operator, token: TokenName) -> TokenLine:
    """Revoke a token and the sessions that it began."""
    revoke_token(service.db, token, who.name)
    service.authenticator.refresh()
    return next(TokenLine(**row) for row in tokens(service.db) if row["name"] == token)
