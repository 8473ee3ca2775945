"""Serve lists in pages, the newest first: `before` names the last line of one page, `Link` the next page (RFC 8288)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final
from urllib.parse import urlencode

from fastapi import Depends, Query, Request, Response

from ident_service.daemon.jobs.requests import Id
from ident_service.registry.database import Row

Most = Annotated[int, Query(ge=1, le=500, description="lines of one page")]
BeforeNumber = Annotated[
    int | None, Query(ge=0, lt=2**62, description="go on after the line of this number; `Link` names the next page")
]
BeforeId = Annotated[Id | None, Query(description="go on after the line of this id; `Link` names the next page")]
PAGES: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "headers": {
            "Link": {
                "description": 'The next page, as `<path?query>; rel="next"`; not there after the last one.',
                "schema": {"type": "string"},
            }
        }
    }
}
"""Description of the `Link` header, for `responses` of a route."""


class Pager:
    """Reader of one page of a list for a request."""

    def __init__(self, request: Request, response: Response) -> None:
        """Take the request, which names the page, and the response, which gets the `Link` header."""
        self._request, self._response = request, response

    def __call__(self, most: int, read: Callable[[int], Sequence[Row]], key: str = "id") -> list[Row]:
        """Return the lines of one page, and name the next page in the header.

        Args:
            most: lines of a page.
            read: returns so many lines.
            key: column of the lines that `before` takes.
        """
        found = read(most + 1)
        if len(found) > most:
            query = [(name, value) for name, value in self._request.query_params.multi_items() if name != "before"]
            query.append(("before", str(found[most - 1][key])))
            self._response.headers["Link"] = f'<{self._request.url.path}?{urlencode(query)}>; rel="next"'
        return list(found[:most])


Page = Annotated[Pager, Depends()]
