"""Render pages from templates: every value is escaped, no script or style stands inline.

The content security policy of a page allows scripts, styles and connections of this service only. Its referrer policy
is `same-origin`, because with `no-referrer` a browser sends `Origin: null` with a form, which the middleware refuses.
"""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime
from functools import lru_cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, Final

from fastapi.responses import HTMLResponse
from jinja2 import Environment, PackageLoader, StrictUndefined

from ident_service import __version__
from ident_service.registry.tokens import Access

STATIC: Final = {
    "page.css": "text/css",
    "page.js": "text/javascript",
    "live.js": "text/javascript",
    "again.js": "text/javascript",
    "upload.js": "text/javascript",
    "news.js": "text/javascript",
    "viewer.js": "text/javascript",
}
THREE: Final = {"three.module.min.js": "text/javascript", "three.core.min.js": "text/javascript"}
"""Vendored files that the arm in three dimensions is drawn by; `viewer.js` loads them from its own folder."""
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "same-origin",
}


VIEWER: Final = "rapidoc-min.js"
# Policy of the page with the API viewer, which uses inline styles; it may send no form.
_VIEWER_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)


def page(name: str, who: Access | None, status: int = 200, **values: Any) -> HTMLResponse:
    """Render a template as a page.

    Args:
        name: of the template, without its ending.
        who: the caller; None for one that is not logged in.
        status: of the answer.
        values: of the template; every one that it names must be there.
    """
    text = _environment().get_template(f"{name}.html").render(who=who, version=__version__, mark=mark(), **values)
    return HTMLResponse(text, status, headers=_HEADERS)


def viewer_page() -> HTMLResponse:
    """Return the page with the vendored viewer of the API's description; nothing is loaded from elsewhere."""
    text = _environment().get_template("api.html").render(mark=mark(), viewer=viewer_version())
    return HTMLResponse(text, headers={**_HEADERS, "Content-Security-Policy": _VIEWER_POLICY})


def viewer_file() -> bytes:
    """Read the viewer's script."""
    return _vendored().joinpath(VIEWER).read_bytes()


@lru_cache(maxsize=1)
def viewer_version() -> str:
    """Return the part of the viewer's address that changes with its version."""
    told = json.loads(_vendored().joinpath("vendored.json").read_text(encoding="utf-8"))
    return f"{told['package']}-{told['version']}"


def _vendored() -> Traversable:
    return files(__package__).joinpath("vendored")


@lru_cache(maxsize=1)
def static() -> dict[str, bytes]:
    """Return the static files of pages, name to content."""
    place = files(__package__).joinpath("static")
    own = {name: place.joinpath(name).read_bytes() for name in STATIC}
    return own | {name: _vendored().joinpath(name).read_bytes() for name in THREE}


@lru_cache(maxsize=1)
def mark() -> str:
    """Return the part of the static files' addresses that changes with their content, so that browsers cache them."""
    return hashlib.sha256(b"".join(static().values())).hexdigest()[:12]


@lru_cache(maxsize=1)
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader(str(__package__)),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(when=_when, lasting=_duration_text, short=_short)
    return environment


def _when(seconds: float | None) -> str:
    """Format a time [s since 1970] in UTC."""
    if seconds is None:
        return "\u2014"
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _duration_text(seconds: float | None) -> str:
    """Format a duration [s]."""
    if seconds is None:
        return "\u2014"
    minutes, rest = divmod(round(seconds), 60)
    return " ".join([*([f"{minutes} min"] if minutes else []), *([f"{rest} s"] if rest or not minutes else [])])


def _short(sha256: str) -> str:
    """Return the first 12 digits of a hash."""
    return sha256[:12]
