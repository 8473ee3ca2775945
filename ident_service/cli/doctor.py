"""The verb `doctor`: is this computer fit to move an arm, and at which rates?

Boundary: words to requests, results to words; the work is `motion/doctor.py`.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer import DONE, VERDICT_NO, Answer, StopOnSignal, tell
from ident_service.cli.words import Verbs, seconds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ident_service.motion.doctor import Finding, Held, Woken

_DEFAULT_RATE = 1000.0  # Hz
_DOUBT = 3.0  # events that a Poisson process of which none came has at most, with 95 %


def add(verbs: Verbs) -> None:
    """Register the verb."""
    text = "is this computer fit to move an arm, and at which rates? (exit code 3: not at the described arm's)"
    sub = verbs.add("doctor", _doctor, text)
    sub.add_argument("arm", nargs="?", metavar="ARM", help="description file, or the name of a shipped one")
    sub.add_argument("--seconds", type=seconds, default=60.0, help="how long lateness is measured (60)")


def _doctor(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.control import Realtime
    from ident_service.config.load import load_arm
    from ident_service.motion.doctor import bus_findings, judge_rates, kernel_findings, measure_wake_up, measuring_rate
    from ident_service.motion.factory import make_arm

    config = None if arguments.arm is None else load_arm(arguments.arm)
    settings = Realtime() if config is None else config.realtime
    rate = _DEFAULT_RATE if config is None else config.control.rate
    watchdogs = () if config is None or config.driver is None else make_arm(config).watchdogs()
    findings = kernel_findings(settings) + ([] if config is None else bus_findings(config))
    tell(arguments, f"measuring for {arguments.seconds:g} s how late a loop wakes; Ctrl-C ends it early")
    stopping = StopOnSignal()
    with stopping:
        woken = measure_wake_up(measuring_rate(rate), arguments.seconds, settings, stop_requested=stopping.requested)
    held = judge_rates(woken, rate, None if config is None else config.control.longest_stall, watchdogs)
    (own,) = [one for one in held if abs(one.rate - rate) < 1e-6 * rate]
    name = None if config is None else config.name
    code = DONE if config is None or own.good else VERDICT_NO
    return code, _text(name, own, findings, woken, held), _document(name, own, findings, woken, held)


def _text(arm: str | None, own: Held, findings: Sequence[Finding], woken: Woken, held: Sequence[Held]) -> str:
    words = {"good": "ok", "poor": "POOR", "unknown": "unknown"}
    lines = list[str]()
    for one in findings:
        lines.append(f"  {words[one.state.value]:<8} {one.what}: {one.found}")
        lines += [f"{'':11}-> {one.remedy}"] if one.remedy else []
    lines += ["", f"woken every {1e3 * woken.period:g} ms for {woken.seconds:.0f} s, {woken.sentence}"]
    late = f"late by {1e3 * float(woken.late.max()):.3g} ms at worst, {1e3 * woken.share(0.999):.3g} ms at 99.9 %"
    lines.append(f"  {late}, {1e3 * woken.share(0.5):.3g} ms at the median")
    host = "" if woken.stolen is None else f"; {woken.stolen:.1%} of the time went to others on this machine's host"
    lines += [f"  load {woken.load:.2f}; {woken.faults} pages had to be found{host}", ""]
    for each in held:
        often = _hourly(each.stalls, woken.seconds)
        lines.append(
            f"  {'holds' if each.good else 'FAILS':<8} {each.rate:g} Hz: {each.stalls} stalls of more than "
            f"{1e3 * each.longest_stall:g} ms, {often}; {100.0 * each.late:.2g} % of the worst second's cycles late "
            "(5 % are survived)"
        )
    if arm is not None:
        verdict = "can be held" if own.good else "CANNOT BE HELD"
        lines += ["", f"{arm}: {own.rate:g} Hz {verdict} by this computer as it was loaded now"]
    return "\n".join([*lines, ""])


def _hourly(stalls: int, seconds: float) -> str:
    """Say how many an hour that is, or, where none came, what the time is long enough to exclude."""
    if stalls == 0:
        return f"so fewer than {3600.0 * _DOUBT / seconds:.0f} an hour (95 %)"
    return f"{3600.0 * stalls / seconds:.0f} an hour"


def _document(
    arm: str | None, own: Held, findings: Sequence[Finding], woken: Woken, held: Sequence[Held]
) -> dict[str, Any]:
    return {
        "arm": arm,
        "rate": own.rate,
        "can_hold": own.good,
        "findings": [
            {"what": one.what, "state": one.state.value, "found": one.found, "remedy": one.remedy} for one in findings
        ],
        "measured": {
            "seconds": woken.seconds,
            "period": woken.period,
            "granted": woken.sentence,
            "worst_late": float(woken.late.max()),
            "p999_late": woken.share(0.999),
            "median_late": woken.share(0.5),
            "stolen_share": woken.stolen,
            "page_faults": woken.faults,
            "load": woken.load,
        },
        "rates": [
            {
                "rate": one.rate,
                "holds": one.good,
                "longest_stall": one.longest_stall,
                "stalls": one.stalls,
                "stalls_per_hour": 3600.0 * one.stalls / woken.seconds,
                "late_share_of_worst_second": one.late,
            }
            for one in held
        ],
    }
