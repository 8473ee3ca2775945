"""Verbs about arm descriptions: `config check`.

Boundary: words to calls, results to words; the work is `config/load.py` and `service/bus.py`.
"""

from __future__ import annotations

import argparse

from ident_service.cli.answer import DONE, Answer
from ident_service.cli.words import Verbs


def add(verbs: Verbs) -> None:
    """Register `config check`."""
    config = verbs.group("config", "arm descriptions")
    check = config.add("check", _check, "every mistake with file, line and column")
    check.add_argument("file", metavar="FILE")


def _check(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.service.bus import bus_lines, require_budget

    model = arm_model(load_arm(arguments.file))
    budget = require_budget(arguments.file, model.config)
    text = "" if budget is None else bus_lines(budget)
    text += (
        f"{arguments.file}: {model.config.name}, {model.chain.joints} joints, {model.layout.size} parameters: good\n"
    )
    return DONE, text, {"file": arguments.file, "arm": model.config.name, "sha256": model.config.sha256, "problems": []}
