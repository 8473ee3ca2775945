"""Authenticate callers by tokens and sessions of the page, and throttle failed attempts.

Tokens and sessions are in the registry, where each request but two looks them up. A stop and the renewal of a lease ask
a copy in memory, and so wait for nobody (`known`).
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

from ident_service.registry.database import Database
from ident_service.registry.tokens import Access, begin_session, digest, digests, end_session, sessions

SESSION_SECONDS: Final = 12 * 3600.0
CHALLENGE_SECONDS: Final = 60.0
_MOST_SESSIONS, _MOST_CHALLENGES, _MOST_ADDRESSES = 1000, 1000, 10_000
_WINDOW: Final = 60.0  # s
_FAILURES = 10  # in a window, from one address or of one token


Key = TypeVar("Key")
Value = TypeVar("Value")


class Throttled(Exception):
    """Error after too many failed attempts; the next attempt counts after `seconds` [s]."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        super().__init__(f"too many failed attempts; again in {seconds:.0f} s")


class Throttle:
    """Counter of failed attempts, per address and per token.

    There is no total over all callers: nobody guesses 256 bits, and failures elsewhere must lock out nobody here.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()

    def require(self, *keys: str) -> None:
        """Raise Throttled if one of these keys, an address or a token's digest, has failed too often."""
        if (wait := max(self._wait(self._failures.get(key, deque())) for key in keys)) > 0.0:
            raise Throttled(wait)

    def failed(self, *keys: str) -> None:
        """Count one failed attempt for each key."""
        for key in keys:
            _remember(self._failures, key, self._failures.get(key, deque(maxlen=_FAILURES)), _MOST_ADDRESSES)
            self._failures[key].append(self._now())

    def _wait(self, failures: deque[float]) -> float:
        full = len(failures) == _FAILURES
        return _WINDOW - (self._now() - failures[0]) if full else 0.0


@dataclass(frozen=True)
class _Challenge:
    arm: str
    who: str
    until: float


class Authenticator:
    """Authenticator of callers by tokens, sessions and challenges."""

    def __init__(self, db: Database, now: Callable[[], float] = time.monotonic) -> None:
        """Begin with the tokens and sessions that the registry knows.

        Args:
            db: the registry.
            now: clock of challenges and throttle [s]; sessions outlast this process and end by the machine's time.
        """
        self._db, self._now, self._lock = db, now, threading.Lock()
        self._throttle = Throttle(now)
        self._good: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._sessions: dict[str, tuple[str, float]] = {}
        self._challenges: OrderedDict[str, _Challenge] = OrderedDict()

        self.refresh()

    def refresh(self) -> None:
        """Copy tokens and sessions from the registry, where another process may have changed them."""
        self._tokens, self._sessions = digests(self._db), sessions(self._db)

    def known(self, token: str | None, session: str | None) -> Access | None:
        """Return the caller's name and role by the copy in memory: by token or, without one, by session; else None.

        A token that was revoked at a terminal counts here until the next `refresh`, which each request brings about.
        """
        key = None if token is None else digest(token)
        if token is None and session is not None:
            key, until = self._sessions.get(digest(session), (None, 0.0))
            key = key if until >= time.time() else None
        return None if key is None else self._tokens.get(key)

    def by_token(self, token: str, address: str) -> Access | None:
        """Return a token's name and role by the registry; if unknown, count a failure, None; Throttled after too many.

        Raises:
            Throttled: too many failed attempts; a token that was good from this address before is still heard.
        """
        key = (address, digest(token))
        with self._lock:
            if key not in self._good:
                self._throttle.require(*key)
        self._tokens = digests(self._db)
        found = self._tokens.get(key[1])
        with self._lock:
            if found is None:
                self._good.pop(key, None)
                self._throttle.failed(*key)
            else:
                _remember(self._good, key, None, _MOST_ADDRESSES)
        return found

    def log_in(self, token: str, address: str) -> tuple[str, Access] | None:
        """Begin a session for a token; return (the session's secret, its name and role), None for an unknown token."""
        found = self.by_token(token, address)
        if found is None:
            return None
        session = secrets.token_urlsafe(32)
        begin_session(self._db, session, token, time.time() + SESSION_SECONDS, _MOST_SESSIONS)
        self.refresh()
        return session, found

    def by_session(self, session: str) -> Access | None:
        """Read the registry anew and return name and role behind a session; None if it is unknown or has expired."""
        self.refresh()
        return self.known(None, session)

    def log_out(self, session: str) -> None:
        """End a session."""
        end_session(self._db, session)
        self.refresh()

    def challenge(self, arm: str, who: str) -> str:
        """Make a random word by which this caller confirms one motion of an arm, once, within a short time."""
        word = secrets.token_urlsafe(16)
        with self._lock:
            entry = _Challenge(arm, who, self._now() + CHALLENGE_SECONDS)
            _remember(self._challenges, word, entry, _MOST_CHALLENGES)
        return word

    def confirm(self, challenge_word: str, arm: str, who: str) -> bool:
        """Return whether the challenge was given to this caller for this arm and still counts; use it up either way."""
        with self._lock:
            entry = self._challenges.pop(challenge_word, None)
        return entry is not None and (entry.arm, entry.who) == (arm, who) and entry.until >= self._now()


def _remember(table: OrderedDict[Key, Value], key: Key, value: Value, most: int) -> None:
    """Add an entry as the newest, and drop the oldest ones where there are too many."""
    table[key] = value
    table.move_to_end(key)
    while len(table) > most:
        table.popitem(last=False)
