"""Render pages from templates: every value is escaped, no script or style stands inline.

The content security policy of a page allows scripts, styles and connections of this service only. Its referrer policy
is `same-origin`, because with `no-referrer` a browser sends `Origin: null` with a form, which the middleware refuses.
"""

from __future__ import annotations

import hashlib
import json
import math
from datetime import UTC, datetime
from functools import lru_cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, Final

from fastapi.responses import HTMLResponse, Response
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ident_service import __version__
from ident_service.registry.tokens import Access
from ident_service.results.plots import format_number

_SCRIPTS: Final = ("page", "plots", "live", "again", "upload", "news", "series", "table", "trends", "new", "viewer")
STATIC: Final = {
    "page.css": "text/css",
    "icon.svg": "image/svg+xml",
    **{f"{name}.js": "text/javascript" for name in _SCRIPTS},
}
VENDORED: Final = {
    "uPlot.iife.min.js": "text/javascript",
    "uPlot.min.css": "text/css",
    "three.module.min.js": "text/javascript",
    "three.core.min.js": "text/javascript",
}
"""Files of others that pages load beside those of `STATIC`: plots, and the arm in three dimensions."""
_LONGEST: Final = 90  # characters of a sentence in a list
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


def page(template_name: str, who: Access | None, status: int = 200, **values: Any) -> HTMLResponse:
    """Render a template as a page.

    Args:
        template_name: of the template, without its ending.
        who: the caller; None for one that is not logged in.
        status: of the answer.
        values: of the template; every one that it names must be there.
    """
    text = (
        _environment()
        .get_template(f"{template_name}.html")
        .render(who=who, version=__version__, mark=static_version(), **values)
    )
    return HTMLResponse(text, status, headers=_HEADERS)


def picture(svg: str) -> Response:
    """Return an SVG as the answer to a browser, which may keep it for 10 min; what is in it can load nothing."""
    headers = {
        "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'self'; sandbox",
        "Cache-Control": "private, max-age=600",
    }
    return Response(svg, media_type="image/svg+xml", headers=headers)


def viewer_page() -> HTMLResponse:
    """Return the page with the vendored viewer of the API's description; nothing is loaded from elsewhere."""
    text = _environment().get_template("api.html").render(mark=static_version(), viewer=viewer_version())
    return HTMLResponse(text, headers={**_HEADERS, "Content-Security-Policy": _VIEWER_POLICY})


def viewer_file() -> bytes:
    """Return the content of the script of the API's viewer."""
    return _vendored().joinpath(VIEWER).read_bytes()


@lru_cache(maxsize=1)
def viewer_version() -> str:
    """Return `PACKAGE-VERSION` of the API's viewer, a part of its address, so that browsers load a new version."""
    document = json.loads(_vendored().joinpath("rapidoc.json").read_text(encoding="utf-8"))
    return f"{document['package']}-{document['version']}"


def _vendored() -> Traversable:
    return files("ident_service").joinpath("vendored")


@lru_cache(maxsize=1)
def static_files() -> dict[str, bytes]:
    """Return the static files of pages, name to content."""
    own, others = files(__package__).joinpath("static"), _vendored()
    return {
        **{name: own.joinpath(name).read_bytes() for name in STATIC},
        **{name: others.joinpath(name).read_bytes() for name in VENDORED},
    }


@lru_cache(maxsize=1)
def static_version() -> str:
    """Return 12 digits of the hash of all static files, a part of their addresses, so that browsers can keep them."""
    return hashlib.sha256(b"".join(static_files().values())).hexdigest()[:12]


@lru_cache(maxsize=1)
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader(str(__package__)),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        when=when, lasting=_duration_text, short=_short, figure=_figure, share=_share, brief=_brief
    )
    return environment


def when(seconds: float | None) -> Markup:
    """Format a time [s since 1970] in UTC as an element that `page.js` turns into local time; a dash for None."""
    if seconds is None:
        return Markup("\u2014")
    at = datetime.fromtimestamp(seconds, UTC)
    return Markup('<time datetime="{}">{} UTC</time>').format(
        at.isoformat(timespec="seconds"), at.strftime("%Y-%m-%d %H:%M:%S")
    )


def _duration_text(seconds: float | None) -> str:
    """Format a duration [s]."""
    if seconds is None:
        return "\u2014"
    hours, rest = divmod(round(seconds), 3600)
    minutes, rest = divmod(rest, 60)
    parts = [(hours, "h"), (minutes, "min"), (rest, "s")]
    return " ".join(f"{value} {unit}" for value, unit in parts if value) or (f"{seconds:.2g} s" if seconds else "0 s")


def _figure(value: float | None, digits: int = 3) -> str:
    """Format a number for people, as the report does."""
    if value is None or not math.isfinite(value):
        return "\u2014"
    return format_number(value, digits)


def _share(value: float | None, limit: float | None) -> str:
    """Format a value as a share of its limit."""
    if value is None or not limit:
        return ""
    return f"{100.0 * abs(value) / limit:.0f} %"


def _brief(words: str) -> str:
    """Return the first clause of a long sentence, so that a list stays one."""
    first = words.split(";")[0]
    return first if len(first) <= _LONGEST else f"{first[: _LONGEST - 1].rstrip()}\u2026"


def _short(sha256: str) -> str:
    """Return the first 12 digits of a hash."""
    return sha256[:12]
