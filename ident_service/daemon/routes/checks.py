"""Limit how many descriptions are checked at the same time, so that they delay no other request."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from fastapi import HTTPException

MOST_CHECKS: Final = 2


class Checks:
    """Limited number of slots for descriptions that are being checked."""

    def __init__(self) -> None:
        self._places = threading.BoundedSemaphore(MOST_CHECKS)

    @contextmanager
    def slot(self) -> Iterator[None]:
        """Take one of `MOST_CHECKS` slots during the block; raise HTTPException 503 at once where none is free.

        Raises:
            HTTPException: 503 where all are taken; waiting would keep a thread from other requests.
        """
        if not self._places.acquire(blocking=False):
            raise HTTPException(
                503, f"{MOST_CHECKS} descriptions are being checked; try again", headers={"Retry-After": "2"}
            )
        try:
            yield
        finally:
            self._places.release()
