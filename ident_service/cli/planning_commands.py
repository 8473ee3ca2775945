"""Commands before a motion: `design`, `preview`, `new`, `config check`, `bus`, `driver`, `doctor`, `emulate`."""

from __future__ import annotations

import argparse
import json
import os
import select
import sys
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.arguments import (
    Parser,
    VerbList,
    add_arm,
    add_repeatable,
    count,
    frequency,
    seconds,
    seed,
    share,
    weight,
    workers,
)
from ident_service.cli.motion_commands import add_dry_run, dry_run
from ident_service.cli.next_command import shell_line
from ident_service.cli.output import (
    DONE,
    USAGE,
    VERDICT_NO,
    Answer,
    StopOnSignal,
    is_terminal,
    print_to_person,
    tell,
    writable_state_folder,
)
from ident_service.cli.progress import step_of, typed_confirmation
from ident_service.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ident_service.excitation.search import Progress
    from ident_service.motion.doctor import Finding, Held, Woken
    from ident_service.operations.motion_design import PriorData


_UNFINISHED = "the search ended before its first start was complete; give it more time"
_CRITERIA = ("d_optimal", "condition_number", "a_optimal")
_FAMILY = ("motion", "base_frequency", "harmonics", "periods", "ramp", "postures")
_MARGINS = ("criterion", "position_margin", "torque_margin")


def _add_motions(verbs: VerbList) -> None:
    """Register `design` and `preview`."""
    sub = verbs.add(
        "design",
        _design,
        "search for the most informative motion within limits",
        examples=(
            "planar2 --search-time 20",
            "my_arm.yaml --length 30 --out motion",
            "planar2 --parameter fv2 --after run.mcap",
        ),
    )
    add_arm(sub)
    sub.add_argument("--criterion", choices=_CRITERIA, help="default: the arm's")
    sub.add_argument(
        "--parameter",
        action="append",
        dest="chosen",
        metavar="EXPRESSION",
        help="a base parameter as `ident base-parameters` prints it, to be known best (a_optimal); may be repeated",
    )
    sub.add_argument("--motion", choices=["fourier", "postures"], help="default: the arm's")
    length = "of the motion, ramps included: whole periods of about the base frequency (default: the arm's)"
    sub.add_argument("--length", type=seconds, metavar="SECONDS", help=length)
    sub.add_argument("--base-frequency", type=frequency, metavar="HZ")
    sub.add_argument("--harmonics", type=count, metavar="N")
    sub.add_argument("--periods", type=count, metavar="N")
    sub.add_argument("--ramp", type=weight, metavar="SECONDS", help="duration of each ramp, from rest and back")
    sub.add_argument("--postures", type=count, metavar="N", help="number of postures")
    sub.add_argument("--position-margin", type=weight, metavar="RAD", help="margin to every position limit")
    sub.add_argument("--torque-margin", type=share, metavar="SHARE", help="margin, as a share of every torque limit")
    _add_prior_data_options(sub)
    sub.add_argument("--seed", type=seed, default=0, help="seed of the random starts")
    searched = "time for the search, not the motion's length (default: 60, or none with --starts)"
    sub.add_argument("--search-time", type=seconds, metavar="SECONDS", help=searched)
    sub.add_argument("--seconds", dest="search_time", type=seconds, help=argparse.SUPPRESS)  # former name
    sub.add_argument("--starts", type=count, metavar="N", help="number of random starts; makes the result reproducible")
    sub.add_argument("--workers", type=workers, default=2, metavar="N", help="processes")
    sub.add_argument("--resume", type=Path, metavar="FILE", help="search.json of an earlier design, to continue from")
    sub.add_argument("--out", type=Path, metavar="DIR", help="default: a new folder below the state folder")

    sub = verbs.add(
        "preview",
        _preview,
        "show a motion's demands and its expected accuracy",
        more="Exit code 3: the arm's limits refuse it.",
        examples=("planar2", "my_arm.yaml motion/motion.json --out preview"),
    )
    add_arm(sub, motion=True)
    _add_prior_data_options(sub)
    sub.add_argument("--out", type=Path, metavar="DIR", help="also write the text and the figures there")


def _add_prior_data_options(sub: Parser) -> None:
    sub.add_argument(
        "--model", type=Path, metavar="FILE", help="parameters.json to predict torques with, instead of the prior"
    )
    sub.add_argument("--noise", type=Path, metavar="FILE", help="parameters.json whose residuals are the noise")
    add_repeatable(sub, "--after", "RECORDING", "add to the information of this recording, or of FILE@41:60", Path)


def _knowledge(arguments: argparse.Namespace) -> PriorData:
    from ident_service.operations.motion_design import PriorData

    return PriorData(arguments.model, arguments.noise, tuple(arguments.after))


def _design(arguments: argparse.Namespace) -> Answer:
    import numpy as np

    from ident_service.config.load import load_arm
    from ident_service.excitation.search import Budget
    from ident_service.operations.motion_design import FILES, SEARCH, DesignRequest, design_files
    from ident_service.operations.motion_preview import preview_document, preview_text
    from ident_service.registry.state_folder import new_run_folder

    keys = (*_FAMILY, *_MARGINS)
    changes: dict[str, Any] = {key: value for key in keys if (value := getattr(arguments, key)) is not None}
    if arguments.chosen is not None:
        if arguments.criterion not in (None, "a_optimal"):
            raise UsageError(f"--parameter is for a_optimal, not for {arguments.criterion}")
        changes |= {"criterion": "a_optimal", "parameters": tuple(arguments.chosen)}
    limit = arguments.search_time if arguments.search_time is not None or arguments.starts is not None else 60.0
    request = DesignRequest(
        arm=arguments.arm,
        changes=changes,
        knowledge=_knowledge(arguments),
        seed=arguments.seed,
        budget=Budget(limit, arguments.starts, arguments.workers),
        resume=arguments.resume,
        length=arguments.length,
    )
    folder = arguments.out or new_run_folder(writable_state_folder(arguments), load_arm(arguments.arm).name, "motions")
    stopping = StopOnSignal()
    with stopping:
        designed, seen = design_files(request, folder, _progress(arguments), stopping.requested)
    unfinished = "" if designed.found.finished or request.resume else _UNFINISHED
    if stopping.requested():
        unfinished = f"interrupted; the best motion so far is written, and --resume {folder / SEARCH} searches on"
    if unfinished:
        print_to_person(f"ident: {unfinished}\n")
    teaches = bool(np.isfinite(seen.deviations).any())
    binding = "".join(f"  {line}\n" for line in designed.binding)
    binding = f"limits that restrict the motion\n{binding}\n" if binding else ""
    text = preview_text(seen) + f"\n{binding}files: {folder}\n" + "".join(f"  {name}\n" for name in FILES)
    document: dict[str, Any] = {
        "folder": str(folder),
        "starts": designed.found.finished,
        "criterion": designed.excitation.made["criterion"],
        "criterion_value": designed.excitation.made["criterion_value"],
    }
    document |= preview_document(seen)
    document["binding"] = list(designed.binding)
    document["warnings"] = [*([unfinished] if unfinished else []), *seen.warnings]
    return (VERDICT_NO if seen.objections or not teaches else DONE), text, document


def _progress(arguments: argparse.Namespace) -> Callable[[Progress], None]:
    """Return a callback that shows the progress of a search: a bar on a terminal, else a line every 10 s."""
    step, terminal = step_of(arguments), is_terminal(sys.stderr) and not arguments.json
    last = [-10.0]

    def show(progress: Progress) -> None:
        if terminal:
            found = "" if progress.best is None else f", best {progress.best:.4g}"
            known = progress.remaining == progress.remaining
            step(f"{progress.phase}: {progress.finished}{found}", None, progress.remaining if known else None)
            return
        best = "" if progress.best is None else f", best {progress.best:.4f}"
        left = f", about {progress.remaining:.0f} s left" if progress.remaining == progress.remaining else ""
        act = "searching" if progress.phase == "starts" else "improving the best"
        words = f"{act}: {progress.finished} starts complete{best}, {progress.elapsed:.0f} s{left}"
        if progress.elapsed - last[0] >= 10.0:
            last[0] = progress.elapsed
            tell(arguments, words)

    return show


def _preview(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.motion_design import preview_files
    from ident_service.operations.motion_preview import preview_document, preview_text

    seen = preview_files(arguments.arm, arguments.motion, _knowledge(arguments), arguments.out)
    text = preview_text(seen)
    document = preview_document(seen)
    if arguments.out is not None:
        text += f"\nfiles: {arguments.out}\n"
        document["folder"] = str(arguments.out)
    return (VERDICT_NO if seen.objections else DONE), text, document


def _add_configs(verbs: VerbList) -> None:
    """Register `new` and `config check`."""
    new = verbs.add(
        "new",
        _new,
        "write a first description of an arm",
        more="From its URDF, MJCF or DH table, with a simulated driver.",
        examples=(
            "robot.urdf",
            "robot.xml --tip wrist_3_link --out my_arm.yaml",
            "table.csv --convention modified",
        ),
    )
    help_source = "URDF (.urdf, .xml), MJCF (.xml), or DH table (.csv, .yaml)"
    new.add_argument("source", metavar="FILE", type=Path, help=help_source)
    new.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help="file to write; its folder is made where there is none (default: NAME.yaml here)",
    )
    new.add_argument("--name", help="of the arm (default: the file's)")
    new.add_argument("--base", metavar="LINK", help="base link of the arm (default: found)")
    new.add_argument("--tip", metavar="LINK", help="last link of the arm (default: where the gripper begins)")
    help_convention = "of a DH table that does not say it: standard (distal frames) or modified (Craig)"
    new.add_argument("--convention", choices=["standard", "modified"], help=help_convention)
    config = verbs.group("config", "check arm descriptions")
    check = config.add(
        "check",
        _check,
        "check a description",
        more="Mistakes come with file, line and column; then the stability of the gains (exit code 3: unstable).",
        examples=("my_arm.yaml", "wam7"),
    )
    check.add_argument("file", metavar="FILE")
    schema = verbs.add(
        *("schema", _schema, "print the JSON schema of a file format"),
        examples=("arm", "parameters"),
    )
    schema.add_argument("of", metavar="FORMAT", choices=_SCHEMAS, help=f"{', '.join(_SCHEMAS)}; arm is a description")


_SCHEMAS = ("arm", "comparison", "evidence", "parameters", "payload")


def _schema(arguments: argparse.Namespace) -> Answer:
    from importlib.resources import files

    from ident_service.config.yaml_source import arm_schema_file

    of = arguments.of
    file = arm_schema_file() if of == "arm" else files("ident_service.results").joinpath(f"{of}.schema.json")
    text = file.read_text(encoding="utf-8")
    return DONE, text, json.loads(text)


def _new(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.new_description import new_description

    def tell(line: str) -> None:
        print_to_person(f"{line} ...\n")

    folder = Path.cwd() if arguments.out is None else arguments.out.parent
    made = not folder.exists()
    words = (arguments.source, arguments.out, arguments.name, arguments.base, arguments.tip)
    path, guessed = new_description(*words, tell, arguments.convention)
    lines = [f"{path}: description written, with a simulated driver{', in a folder made for it' if made else ''}"]
    lines += ["guessed or chosen:", *(f"  {line}" for line in guessed)] if guessed else []
    return DONE, "\n".join([*lines, ""]), {"description": str(path), "guessed": list(guessed)}


def _check(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.description_check import check_description, description_document, description_text

    checked = check_description(arguments.file)
    document = {"file": arguments.file, **description_document(checked)}
    return DONE if checked.good else VERDICT_NO, description_text(arguments.file, checked), document


def _add_bus(verbs: VerbList) -> None:
    """Register `bus load`, `bus scan` and `bus probe`."""
    bus = verbs.group("bus", "look at the fieldbus of an arm, configure its drives")
    load = bus.add(
        "load",
        _load,
        "show the bus load per frame and in all",
        more="Exit code 3: too much.",
        examples=("wam7_canopen", "wam7_canopen --rate 500"),
    )
    add_arm(load)
    load.add_argument("--rate", type=frequency, metavar="HZ", help="cycles per second (default: control.rate)")
    sub = bus.add(
        "scan",
        _scan,
        "list the nodes with state, identity and errors",
        more="Reads only (exit code 3: not as configured).",
        examples=("wam7_canopen", "my_arm.yaml --json"),
    )
    add_arm(sub)

    sub = bus.add(
        "probe",
        _probe,
        "read what each drive can do",
        more="Modes, units, limits, watchdogs, rate; reads only (exit code 3: unsuitable; 2: a file is no EDS).",
        examples=("wam7_canopen", "my_arm.yaml --eds drive.eds"),
    )
    add_arm(sub)
    help_eds = "EDS or DCF files to read instead of the drives, without a bus"
    sub.add_argument("--eds", nargs="+", default=[], metavar="FILE", help=help_eds)

    sub = bus.add(
        "import",
        _import,
        "write what DCFs of the maker's tool configure",
        more="One file for each drive; changes are listed, drives off meanwhile (exit code 3: a file is cut off).",
        examples=("my_arm.yaml j1.dcf j2.dcf --dry-run", "my_arm.yaml j1.dcf j2.dcf --confirm my_arm"),
    )
    add_arm(sub)
    sub.add_argument("files", nargs="+", metavar="DCF", help="one for each drive, in the order of the description")
    sub.add_argument("--dry-run", action="store_true", help="list the changes, and write nothing")
    sub.add_argument("--confirm", metavar="NAME", help="the arm's name, typed by a person")
    for name, text, more in (
        ("store", "have all drives store what they hold", "Over the loss of power (1010h); drives are off meanwhile."),
        ("restore", "give all drives back what they were shipped with", "At the next loss of power (1011h)."),
    ):
        examples = ("my_arm.yaml --dry-run", "my_arm.yaml --confirm my_arm")
        sub = bus.add(name, _store, text, more=more, examples=examples)
        add_arm(sub)
        sub.add_argument("--dry-run", action="store_true", help="ask whether drives can, and write nothing")
        sub.add_argument("--confirm", metavar="NAME", help="the arm's name, typed by a person")
        sub.set_defaults(stores=name == "store")

    sub = bus.add(
        "report",
        _bus_report,
        "write a ZIP file to send when drives do not work",
        more="Probe, frames, EDS hashes, ticket, versions; no secrets.",
        examples=("my_arm.yaml", "my_arm.yaml --run failed_run --out drives.zip"),
    )
    add_arm(sub)
    sub.add_argument("--out", type=Path, metavar="FILE", help="must not exist (default: below the state folder)")
    sub.add_argument(
        "--run", type=Path, metavar="DIR", help="run folder whose can.log goes along (`ident run --can-log`)"
    )

    driver = verbs.group("driver", "test drivers of arms, your own ones too", more="See docs/drivers.md.")
    sub = driver.add(
        "test",
        _driver_test,
        "try a driver on the promises of the Arm contract",
        more="With zero torque alone (exit code 3: a promise is broken).",
        examples=("planar2", "my_arm.yaml --confirm my_arm"),
    )
    add_arm(sub)
    sub.add_argument(
        "--confirm", metavar="NAME", help="the arm's name: it is supported, and nobody is within its reach"
    )
    add_dry_run(sub)


def _bus_report(arguments: argparse.Namespace) -> Answer:
    from datetime import UTC, datetime

    from ident_service.config.load import load_arm
    from ident_service.operations.fieldbus import bus_report
    from ident_service.registry.state_folder import arm_folder, ticket_path

    config, state = load_arm(arguments.arm), writable_state_folder(arguments)
    if arguments.run is not None and not (arguments.run / "can.log").is_file():
        raise UsageError(f"{arguments.run}: has no can.log; `ident run --can-log` makes one")
    named = f"report-{datetime.now(UTC):%Y%m%d-%H%M%S}.zip"
    path = arguments.out or arm_folder(state, config.name) / named
    frames = None if arguments.run is None else arguments.run / "can.log"
    names = bus_report(config, path, ticket_path(state, config.name), frames)
    text = f"{path}: look into it before you send it\n" + "".join(f"  {name}\n" for name in names)
    return DONE, text, {"path": str(path), "files": names}


def _require_name(arguments: argparse.Namespace, name: str, what: str) -> None:
    """Require that a person has typed the arm's name; raises UsageError."""
    if typed_confirmation(arguments, f"{name}: {what}. Type the arm's name to go on:") != name:
        raise UsageError(f"{what}: that is confirmed by the arm's name, typed: --confirm {name}; nothing was written")


def _import(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm, read_eds_file
    from ident_service.operations.drive_configuration import drives_document, import_configuration, imported_text

    config, dry = load_arm(arguments.arm), arguments.dry_run
    files = [read_eds_file(name) for name in arguments.files]
    if not dry:
        _require_name(arguments, config.name, "drives are configured anew")
    found = import_configuration(config, files, dry=dry)
    return DONE, imported_text(config, found, dry=dry), drives_document(config, found, written=not dry)


def _store(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.operations.drive_configuration import store_or_restore

    config, stores, dry = load_arm(arguments.arm), arguments.stores, arguments.dry_run
    if not dry:
        _require_name(
            arguments, config.name, "drives store what they hold" if stores else "drives lose their configuration"
        )
    nodes = store_or_restore(config, store=stores, dry=dry)
    if dry:
        would = "store what they hold" if stores else "take back what they were shipped with"
        told = f"would {would}; nothing was written"
    else:
        told = "have stored what they hold" if stores else "take back what they were shipped with when power comes next"
    text = f"{config.name}: drives {', '.join(map(str, nodes))} {told}\n"
    return DONE, text, {"arm": config.name, "stored": stores, "written": not dry, "nodes": list(nodes)}


def _driver_test(arguments: argparse.Namespace) -> Answer:
    if arguments.dry_run:
        return dry_run(arguments)
    from ident_service.config.load import load_arm
    from ident_service.motion.arm_factory import Outcome, contract_text, try_driver
    from ident_service.motion.command_channel import ControlFile
    from ident_service.registry.state_folder import control_path

    config = load_arm(arguments.arm)

    with ControlFile.take(control_path(writable_state_folder(arguments), config.name), None):
        found = try_driver(config, partial(typed_confirmation, arguments))
    broken = any(one.outcome is Outcome.BROKEN for one in found)
    document = {"arm": config.name, "kept": not broken, "promises": [asdict(one) for one in found]}
    return VERDICT_NO if broken else DONE, contract_text(config.name, found), document


def _load(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.operations.fieldbus import bus_document, bus_load, bus_text

    config = load_arm(arguments.arm)
    found = bus_load(config, arguments.rate)
    return DONE if found.fits else VERDICT_NO, bus_text(config.name, found), bus_document(config.name, found)


def _scan(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.operations.fieldbus import bus_scan, scan_document, scan_text

    config = load_arm(arguments.arm)
    found = bus_scan(config)
    return DONE if found.complete else VERDICT_NO, scan_text(config, found), scan_document(config, found)


def _probe(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm, read_eds_file
    from ident_service.operations.fieldbus import FILE, bus_probe, probe_document, probe_text, store_probe_outcome
    from ident_service.registry.state_folder import arm_folder

    config = load_arm(arguments.arm)
    found = bus_probe(config, [read_eds_file(name) for name in arguments.eds])
    text, document = probe_text(config, found), probe_document(config, found)
    if not arguments.eds:
        path = arm_folder(writable_state_folder(arguments), config.name) / FILE
        document |= {"changed": store_probe_outcome(path, document), "kept": str(path)}
        text += "".join(f"CHANGED: {line}\n" for line in document["changed"]) + f"kept in {path}\n"
    return DONE if found.good else VERDICT_NO if found.readable else USAGE, text, document


_DEFAULT_RATE = 1000.0  # Hz
_DOUBT = 3.0  # events that a Poisson process of which none came has at most, with 95 %


def _add_doctor(verbs: VerbList) -> None:
    """Register the verb."""
    sub = verbs.add(
        "doctor",
        _doctor,
        "check whether this computer keeps the control rate",
        more="Exit code 3: not that of the arm.",
        examples=("", "my_arm.yaml --seconds 300"),
    )
    add_arm(sub, optional=True)
    sub.add_argument("--seconds", type=seconds, default=60.0, help="duration of the measurement (60)")


def _doctor(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.control import Realtime
    from ident_service.config.load import load_arm
    from ident_service.motion.arm_factory import make_arm
    from ident_service.motion.doctor import bus_findings, judge_rates, kernel_findings, measure_wake_up, measuring_rate

    config = None if arguments.arm is None else load_arm(arguments.arm)
    settings = Realtime() if config is None else config.realtime
    rate = _DEFAULT_RATE if config is None else config.control.rate
    watchdogs = () if config is None or config.driver is None else make_arm(config).watchdogs()
    findings = kernel_findings(settings) + ([] if config is None else bus_findings(config))
    tell(arguments, f"measuring wake-up latency for {arguments.seconds:g} s; Ctrl-C ends it early")
    stopping = StopOnSignal()
    step_of(arguments)("measuring wake-up latency", seconds_left=arguments.seconds)
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
    worst, most = 1e3 * float(woken.late.max()), 1e3 * woken.lateness_quantile(0.999)
    late = f"late by {worst:.3g} ms at worst, {most:.3g} ms at 99.9 %"
    lines.append(f"  {late}, {1e3 * woken.lateness_quantile(0.5):.3g} ms at the median")
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
            "p999_late": woken.lateness_quantile(0.999),
            "median_late": woken.lateness_quantile(0.5),
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


def _add_emulate(verbs: VerbList) -> None:
    """Register `emulate`."""
    sub = verbs.add(
        "emulate",
        _emulate,
        "emulate the drives of an arm on its bus",
        more="Until Ctrl-C; lines on standard input inject faults: `drive_fault joint=j2 at=1`, `clear`, `state`, "
        "`quit`.",
        examples=("wam7_canopen --seconds 60", "wam7_canopen --fault 'drive_fault joint=j2 at=1'"),
    )
    add_arm(sub)
    form = "'KIND [joint=NAME] [at=S] [duration=S] [size=X] [offset=X,Y,Z]', counted from the first SYNC; repeatable"
    add_repeatable(sub, "--fault", "FAULT", form)
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
    from ident_service.config.load import load_arm, with_eds_files
    from ident_service.motion.realtime import temporary_privileges
    from sim_backend.emulator.process import emulate, emulated_buses

    config = with_eds_files(load_arm(arguments.arm), arguments.eds)
    emulated_buses(config)  # refuses before memory is locked, which takes a while
    first = ["set-home", arguments.arm] if config.zeroed_at_home else ["bus", "scan", arguments.arm]
    then = f"; in another terminal: `{shell_line(arguments, first)}`"
    tell(arguments, f"{config.name}: emulated drives; Ctrl-C ends{then}")
    stopping = StopOnSignal()
    # On another core than the motion process, if there is one.
    with stopping, temporary_privileges(core_counted_from_last=1, settings=Realtime(priority=config.realtime.priority)):
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
    return DONE, text, {"arm": config.name, **asdict(done)}


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


def add(verbs: VerbList) -> None:
    """Register the verbs about motions, descriptions, the bus, `doctor` and the emulator."""
    for register in (_add_motions, _add_configs, _add_bus, _add_doctor, _add_emulate):
        register(verbs)
