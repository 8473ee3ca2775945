"""Register and run the verbs about fieldbuses: `bus load`, `bus scan`, `bus probe`."""

from __future__ import annotations

import argparse

from ident_service.cli.answer import DONE, VERDICT_NO, Answer
from ident_service.cli.words import Verbs, frequency

_HELP_ARM = "description file, or the name of a shipped one"


def add(verbs: Verbs) -> None:
    """Register `bus load`, `bus scan` and `bus probe`."""
    bus = verbs.group("bus", "the fieldbus of an arm")
    load = bus.add("load", _load, "what every frame costs, and whether all of them fit (exit code 3: they do not)")
    load.add_argument("arm", metavar="ARM", help=_HELP_ARM)
    load.add_argument("--rate", type=frequency, metavar="HZ", help="cycles per second (default: control.rate)")
    text = "who is on the buses: state, identity, errors; sends SDO uploads only (exit code 3: not who is configured)"
    sub = bus.add("scan", _scan, text)
    sub.add_argument("arm", metavar="ARM", help=_HELP_ARM)

    text = (
        "what each drive can, what it lacks, its watchdogs, torque unit and rate; writes nothing (exit code 3: refused)"
    )
    sub = bus.add("probe", _probe, text)
    sub.add_argument("arm", metavar="ARM", help=_HELP_ARM)
    help_eds = "EDS or DCF files to judge in place of the drives, without a bus"
    sub.add_argument("--eds", nargs="+", default=[], metavar="FILE", help=help_eds)


def _load(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.operations.bus import bus_document, bus_load, bus_text

    config = load_arm(arguments.arm)
    found = bus_load(config, arguments.rate)
    return DONE if found.fits else VERDICT_NO, bus_text(config.name, found), bus_document(config.name, found)


def _scan(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.operations.bus_scan import bus_scan, scan_document, scan_text

    config = load_arm(arguments.arm)
    found = bus_scan(config)
    return DONE if found.complete else VERDICT_NO, scan_text(config, found), scan_document(config, found)


def _probe(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm, sheet_file
    from ident_service.operations.bus_probe import bus_probe, probe_document, probe_text

    config = load_arm(arguments.arm)
    found = bus_probe(config, [sheet_file(name) for name in arguments.eds])
    return DONE if found.good else VERDICT_NO, probe_text(config, found), probe_document(config, found)
