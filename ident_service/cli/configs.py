"""Verbs about arm descriptions: `config check`.

Boundary: words to calls, results to words; the work is `config/load.py`, `motion/preflight/stability.py` and
`service/bus.py`.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer import DONE, VERDICT_NO, Answer
from ident_service.cli.words import Verbs

if TYPE_CHECKING:
    from ident_service.motion.preflight.stability import StabilityReport


def add(verbs: Verbs) -> None:
    """Register `config check`."""
    config = verbs.group("config", "arm descriptions")
    check = config.add(
        "check", _check, "every mistake with file, line and column; whether the gains are stable (exit code 3: not)"
    )
    check.add_argument("file", metavar="FILE")


def _check(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.limits import motion_limits
    from ident_service.config.load import load_arm
    from ident_service.errors import MotionRefused
    from ident_service.model.arm_model import arm_model
    from ident_service.motion.preflight.stability import delay_of, stability
    from ident_service.service.bus import bus_lines, require_budget

    model = arm_model(load_arm(arguments.file))
    config = model.config
    budget = require_budget(arguments.file, config)
    head = f"{arguments.file}: {config.name}, {model.chain.joints} joints, {model.layout.size} parameters: good\n"
    head += "" if budget is None else bus_lines(budget)
    document: dict[str, Any] = {"file": arguments.file, "arm": config.name, "sha256": config.sha256, "problems": []}
    try:
        limits = motion_limits(config)
    except MotionRefused:  # an arm that is only identified needs none
        text = "gains: not judged; limits or gains are missing, so that this arm can be identified but not moved\n"
        return DONE, head + text, {**document, "stability": None}
    report = stability(model, limits, delay_of(config))
    return (
        DONE if report.stable else VERDICT_NO,
        head + _gains_text(report),
        {**document, "stability": {**asdict(report), "stable": report.stable, "objections": report.objections()}},
    )


def _gains_text(report: StabilityReport) -> str:
    """Margins per joint, and what is objected to."""
    joints = report.joints
    width = max(5, *(len(one.joint) for one in joints))
    cycles = "one cycle" if report.delay_cycles == 1 else f"{report.delay_cycles} cycles"
    lines = [
        f"gains at {1.0 / report.period:g} Hz with {cycles} of delay: "
        + ("stable" if report.stable else "NOT STABLE ENOUGH; lower kp and kd, or raise the rate or the cut-off"),
        f"  {'joint':<{width}} {'gain margin':>12} {'delay margin':>13}",
        *(f"  {one.joint:<{width}} {one.gain_margin:>12.2f} {1e3 * one.delay_margin:>10.2f} ms" for one in joints),
    ]
    if report.coupled_radius is None:
        lines.append("  without a prior, each joint is judged by itself")
    else:
        lines.append(f"  all joints together: spectral radius {report.coupled_radius:.6f}, below 1 is stable")
    return "\n".join([*lines, *(f"  {words}" for words in report.objections()), ""])
