"""Verbs about fieldbuses: `bus load`.

Boundary: words to requests, results to words; the work is `service/bus.py`.
"""

from __future__ import annotations

import argparse

from ident_service.cli.answer import DONE, VERDICT_NO, Answer
from ident_service.cli.words import Verbs, frequency


def add(verbs: Verbs) -> None:
    """Register the verbs."""
    bus = verbs.group("bus", "the fieldbus of an arm")
    load = bus.add("load", _load, "what every frame costs, and whether all of them fit (exit code 3: they do not)")
    load.add_argument("arm", metavar="ARM", help="description file, or the name of a shipped one")
    load.add_argument("--rate", type=frequency, metavar="HZ", help="cycles per second (default: control.rate)")


def _load(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.service.bus import bus_document, bus_load, bus_text

    config = load_arm(arguments.arm)
    found = bus_load(config, arguments.rate)
    return DONE if found.fits else VERDICT_NO, bus_text(config.name, found), bus_document(config.name, found)
