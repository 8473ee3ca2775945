"""Who asks, and may they: tokens, sessions of the page, and the throttle of failed attempts.

Boundary: no HTTP here; `asking.py` takes tokens out of requests.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

from ident_service.service.registry.database import Database
from ident_service.service.registry.tokens import Access, access, digest

SESSION_SECONDS: Final = 12 * 3600.0
CHALLENGE_SECONDS: Final = 60.0
_MOST_SESSIONS, _MOST_CHALLENGES, _MOST_ADDRESSES = 1000, 1000, 10_000
_WINDOW: Final = 60.0  # s
_FAILURES_OF_ONE, _FAILURES_OF_ALL = 10, 100  # in a window


Key = TypeVar("Key")
Value = TypeVar("Value")


class Throttled(Exception):
    """Too many failed attempts; `seconds` until the next one counts."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        super().__init__(f"too many failed attempts; again in {seconds:.0f} s")


class Throttle:
    """Counts failed attempts, per address and of all together."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._of_all: deque[float] = deque()
        self._of_one: OrderedDict[str, deque[float]] = OrderedDict()

    def require(self, address: str) -> None:
        """Raise Throttled where an attempt from this address does not count now."""
        wait = max(
            self._wait(self._of_all, _FAILURES_OF_ALL), self._wait(self._of_one.get(address, deque()), _FAILURES_OF_ONE)
        )
        if wait > 0.0:
            raise Throttled(wait)

    def failed(self, address: str) -> None:
        """Count one."""
        now = self._now()
        self._of_all.append(now)
        self._of_one.setdefault(address, deque()).append(now)
        self._of_one.move_to_end(address)
        while len(self._of_one) > _MOST_ADDRESSES:
            self._of_one.popitem(last=False)

    def _wait(self, failures: deque[float], most: int) -> float:
        now = self._now()
        while failures and now - failures[0] > _WINDOW:
            failures.popleft()
        return _WINDOW - (now - failures[-most]) if len(failures) >= most else 0.0


@dataclass(frozen=True)
class _Session:
    secret_digest: str  # of the token: a session ends when its token is revoked
    until: float


@dataclass(frozen=True)
class _Challenge:
    arm: str
    who: str
    until: float


class Gate:
    """Knows who asks."""

    def __init__(self, db: Database, now: Callable[[], float] = time.monotonic) -> None:
        """Begin without sessions.

        Args:
            db: the registry.
            now: clock of sessions, challenges and throttle [s].
        """
        self._db, self._now, self._lock = db, now, threading.Lock()
        self._throttle = Throttle(now)
        self._good: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._sessions: OrderedDict[str, _Session] = OrderedDict()
        self._challenges: OrderedDict[str, _Challenge] = OrderedDict()

    def by_token(self, secret: str, address: str) -> Access | None:
        """Whose token this is; None if nobody's.

        Raises:
            Throttled: too many failed attempts; a token that was good from this address before is still heard.
        """
        key = (address, digest(secret))
        with self._lock:
            if key not in self._good:
                self._throttle.require(address)
        found = access(self._db, secret)
        with self._lock:
            if found is None:
                self._good.pop(key, None)
                self._throttle.failed(address)
            else:
                _remember(self._good, key, None, _MOST_ADDRESSES)
        return found

    def for_stop(self, secret: str) -> Access | None:
        """Whose token this is, whatever failed before: a stop meets no throttle."""
        return access(self._db, secret)

    def log_in(self, secret: str, address: str) -> tuple[str, Access] | None:
        """Exchange a token for a session; None if it is nobody's. Raises as `by_token`."""
        found = self.by_token(secret, address)
        if found is None:
            return None
        session = secrets.token_urlsafe(32)
        with self._lock:
            entry = _Session(digest(secret), self._now() + SESSION_SECONDS)
            _remember(self._sessions, digest(session), entry, _MOST_SESSIONS)
        return session, found

    def by_session(self, session: str) -> Access | None:
        """Whose session this is; None if nobody's, or if its time is over."""
        with self._lock:
            entry = self._sessions.get(digest(session))
            if entry is None or entry.until < self._now():
                self._sessions.pop(digest(session), None)
                return None
        row = self._db.row("SELECT name, role FROM tokens WHERE sha256 = ? AND revoked IS NULL", entry.secret_digest)
        return None if row is None else Access(row["name"], row["role"])

    def log_out(self, session: str) -> None:
        """End a session."""
        with self._lock:
            self._sessions.pop(digest(session), None)

    def challenge(self, arm: str, who: str) -> str:
        """A word that confirms one motion of an arm, once, together with the arm's typed name."""
        word = secrets.token_urlsafe(16)
        with self._lock:
            entry = _Challenge(arm, who, self._now() + CHALLENGE_SECONDS)
            _remember(self._challenges, word, entry, _MOST_CHALLENGES)
        return word

    def confirm(self, word: str, arm: str, who: str) -> bool:
        """Whether the word was given to the same one for the same arm, not too long ago; asking uses it up."""
        with self._lock:
            entry = self._challenges.pop(word, None)
        return entry is not None and (entry.arm, entry.who) == (arm, who) and entry.until >= self._now()


def _remember(table: OrderedDict[Key, Value], key: Key, value: Value, most: int) -> None:
    """Enter the newest, and forget the oldest where there are too many."""
    table[key] = value
    table.move_to_end(key)
    while len(table) > most:
        table.popitem(last=False)
