"""Tell which request a node's answer belongs to, where answers carry no number.

A node answers each request (SYNC, or a GET of positions) once. So the first answer behind a missing one is either the
missing one, late by a cycle, or the present one, and the other was lost. A second one in the same cycle settles it. Of
one that comes alone the time since the request tells it: behind a lost answer the next takes as long as they usually
do; a node that has become late may be late by any time. A node that has stalled, too, answers at any time, but only
once. So it is the third answer in a row at an unusual time that counts as late.

A delay of whole periods, to within what answers usually vary by, is not seen. One that is there from the beginning
shows when a request is left out, which both drivers do when they are opened, and as a hidden delay in preflight.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final, Protocol

from drivers.can.bus_state import EventCode

MARGIN: Final = 0.125  # of a period, later than ever so far, that is still usual; at 1 kHz, the time of one more frame
_BELIEVED: Final = 2  # answers in a row at unusual times that are taken for this cycle's


class AnswerOrder:
    """Count the requests that one node has not answered.

    Attributes:
        behind: number of requests that wait for an answer, the latest included.
        uncertain: whether the last answer may be of an older request, and `believe_uncertain` is to be called.
    """

    __slots__ = ("_doubted", "_earliest_ns", "_latest_ns", "_margin_ns", "behind", "uncertain")

    def __init__(self, period: float = 0.0) -> None:
        """Start with a node that was asked nothing; `period` is of its cycles [s]."""
        self.behind = self._doubted = 0
        self.uncertain = False
        self._margin_ns = round(MARGIN * period * 1e9)
        self._earliest_ns: int | None = None  # that an answer took so far, where it could only be this cycle's
        self._latest_ns = 0

    def take_answer(self, delay_since_request_ns: int | None) -> int | None:
        """Count an answer; return how many requests old it may be, 0 if surely the latest's, None if none was open.

        Args:
            delay_since_request_ns: time since the latest request [ns]; None where it is unknown.

        Returns:
            How many requests ago the one was that it may belong to, 0 where it surely is the latest; None where every
            request has been answered.
        """
        if self.behind == 0:
            return None
        self.behind -= 1
        if self.behind:
            self.uncertain = not self._is_usual(delay_since_request_ns)
            if not self.uncertain:
                self.behind = self._doubted = 0
            return self.behind
        self.uncertain, self._doubted = False, 0
        if delay_since_request_ns is not None:
            if self._earliest_ns is None:
                self._earliest_ns = self._latest_ns = delay_since_request_ns
            elif delay_since_request_ns < self._earliest_ns:
                self._earliest_ns = delay_since_request_ns
            elif delay_since_request_ns > self._latest_ns:
                self._latest_ns = delay_since_request_ns
        return 0

    def take_late(self) -> None:
        """Count an answer outside of every cycle: one request fewer waits for its answer."""
        self.behind = max(0, self.behind - 1)

    def believe_uncertain(self) -> bool:
        """Settle an uncertain answer at a cycle's end; return if it counts as the latest's: at most two in a row do."""
        self.uncertain = False
        self._doubted += 1
        return self._doubted <= _BELIEVED

    def _is_usual(self, delay_ns: int | None) -> bool:
        if delay_ns is None or self._earliest_ns is None:
            return True
        return self._earliest_ns <= delay_ns <= self._latest_ns + self._margin_ns


class AnsweringNode(Protocol):
    """A node that answers each request once, as both kinds of drives do.

    Attributes:
        node: node number.
        answered: whether it has answered in this cycle.
        age: cycles since the request that its last answer is of.
        late: answers that did not count for the cycle in which they came.
        order: order that tells which request an answer belongs to.
    """

    node: int
    answered: bool
    age: int
    late: int
    order: AnswerOrder


def settle_uncertain(nodes: Iterable[AnsweringNode], on_late: Callable[[EventCode, int, str], None]) -> int:
    """Count uncertain answers at a cycle's end as the latest request's, or late; return how many were the latest's.

    Args:
        nodes: of one bus.
        on_late: called with the other nodes, whose answers are late.
    """
    settled = 0
    for one in nodes:
        if not one.order.uncertain:
            continue
        if one.order.believe_uncertain():
            one.answered, one.age = True, 0
            settled += 1
        else:
            one.late += 1
            on_late(EventCode.LATE, one.node, f"its position is {one.age} cycles old")
    return settled
