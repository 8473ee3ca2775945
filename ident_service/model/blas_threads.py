"""Limit BLAS to one thread where matrices are small.

A QR of a thousand rows by seventy gains nothing from a second thread, and loses a factor of ten when another process
wants the same core, because BLAS threads wait by spinning.
"""

from __future__ import annotations

from contextlib import ContextDecorator
from functools import cache
from types import TracebackType
from typing import Any, Self

from threadpoolctl import ThreadpoolController


@cache
def _controller() -> ThreadpoolController:
    # Looking for the libraries takes milliseconds, so it is done once, after numpy and scipy have loaded theirs.
    return ThreadpoolController()


class one_blas_thread(ContextDecorator):  # noqa: N801  # used as a decorator and in `with`, like contextlib's own
    """Limit BLAS to one thread inside a `with` block or a decorated function."""

    def __enter__(self) -> Self:
        """Limit BLAS to one thread."""
        self._limit: Any = _controller().limit(limits=1, user_api="blas")
        self._limit.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Restore the earlier limit."""
        self._limit.__exit__(kind, error, trace)

    def _recreate_cm(self) -> Self:
        # Each call needs limits of its own: decorated functions call each other.
        return type(self)()
