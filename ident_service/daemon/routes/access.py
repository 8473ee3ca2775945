"""Serve the routes about access tokens: list them, revoke one.

Tokens are not made over HTTP: whoever got hold of an operator's token could make others, which would outlive its
revocation. Making one is an act at the state folder (`ident tokens add`). Revoking over HTTP is safe: it cannot lock
out a person at the state folder.
"""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Path
from pydantic import BaseModel

from ident_service.daemon.dependencies import Operator, Serving
from ident_service.daemon.errors import failures, operation_id
from ident_service.registry.tokens import revoke_token, tokens

router = APIRouter(prefix="/api/v1", tags=["tokens"], responses=failures(404), generate_unique_id_function=operation_id)
TokenName = Annotated[str, Path(pattern=r"^[a-z0-9][a-z0-9_.-]{0,39}$")]


class TokenLine(BaseModel):
    """Access token; `revoked` is when it was revoked, null while it is valid. The token itself is stored nowhere."""

    name: str
    role: Literal["viewer", "operator"]
    created: float
    revoked: float | None


@router.get("/tokens")
def list_tokens(service: Serving, _: Operator) -> list[TokenLine]:
    """List all tokens that were ever made, the earliest first."""
    return [TokenLine(**row) for row in tokens(service.db)]


@router.post("/tokens/{token}/revoke")
def revoke(service: Serving, who: Operator, token: TokenName) -> TokenLine:
    """Revoke a token and the sessions that it began."""
    revoke_token(service.db, token, who.name)
    service.gate.refresh()
    return next(TokenLine(**row) for row in tokens(service.db) if row["name"] == token)
