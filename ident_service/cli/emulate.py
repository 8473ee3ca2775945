"""Register and run the verb `emulate`: emulate an arm's drives on its bus."""

from __future__ import annotations

import argparse
import os
import select
import sys
from collections.abc import Callable

from ident_service.cli.answer import DONE, Answer, StopOnSignal, tell
from ident_service.cli.words import Verbs, seconds


def add(verbs: Verbs) -> None:
    """Register `emulate`."""
    sub = verbs.add(
        "emulate",
        _emulate,
        "the drives of an arm, emulated on its configured bus until Ctrl-C; lines on standard input inject faults: "
        "`drive_fault joint=j2 at=1`, `clear`, `state`, `quit`",
    )
    sub.add_argument("arm", metavar="ARM", help="description file, or the name of a shipped one")
    sub.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help="'KIND [joint=NAME] [at=S] [duration=S] [size=X] [offset=X,Y,Z]', counted from the first SYNC; repeatable",
    )
    sub.add_argument(
        "--eds",
        nargs="+",
        default=[],
        metavar="FILE",
        help="EDS or DCF files of real drives, which the drives are emulated by, one after the other",
    )
    sub.add_argument("--seconds", type=seconds, metavar="S", help="stop by itself after this time")


def _emulate(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.control import Realtime
    from ident_service.config.load import load_arm, with_sheets
    from ident_service.motion.realtime import asked
    from sim_backend.emulator.process import emulate

    config = with_sheets(load_arm(arguments.arm), arguments.eds)
    tell(arguments, f"{config.name}: emulated drives; Ctrl-C ends")
    stopping = StopOnSignal()
    # On another core than the motion process, if there is one.
    with stopping, asked(core_from_last=1, settings=Realtime(priority=config.realtime.priority)):
        done = emulate(
            config,
            faults=arguments.fault,
            seconds=arguments.seconds,
            tell=lambda line: tell(arguments, line),
            stop_requested=stopping.requested,
            commands=_lines(),
        )
    rest = "at rest" if done.at_rest else "still moving"
    text = (
        f"emulated for {done.seconds:.1f} s: {done.heard} frames heard, {done.sent} sent, "
        f"{done.unsent} not taken; the arm is {rest}\n"
    )
    document = {
        "arm": config.name,
        "seconds": done.seconds,
        "heard": done.heard,
        "sent": done.sent,
        "unsent": done.unsent,
        "states": list(done.states),
        "at_rest": done.at_rest,
    }
    return DONE, text, document


def _lines() -> Callable[[], str | None]:
    """Return a function that takes the next line of standard input, None while there is none or after its end."""
    # Polled, not read by a thread: a thread that blocks on standard input cannot be ended.
    rest, ended = b"", sys.stdin is None or sys.stdin.closed

    def take() -> str | None:
        nonlocal rest, ended
        while b"\n" not in rest:
            if ended or not select.select([0], [], [], 0.0)[0]:
                return None
            part = os.read(0, 4096)
            rest, ended = rest + part, not part
        line, _, rest = rest.partition(b"\n")
        return line.decode(errors="replace")

    return take
