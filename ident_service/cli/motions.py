"""Register and run the verbs about motions: `design` searches for one, `preview` predicts its demands and use."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer import DONE, VERDICT_NO, Answer, StopOnSignal, own_state_folder, tell
from ident_service.cli.words import Parser, Verbs, count, frequency, seconds, seed, share, weight, workers
from ident_service.errors import UsageError

if TYPE_CHECKING:
    from ident_service.excitation.search import Progress
    from ident_service.operations.design import Knowledge

_UNFINISHED = "the search ended before its first start was finished; more time will find a better motion"
_CRITERIA = ("d_optimal", "condition_number", "a_optimal")
_FAMILY = ("motion", "base_frequency", "harmonics", "periods", "ramp", "postures")
_MARGINS = ("criterion", "position_margin", "torque_margin")


def add(verbs: Verbs) -> None:
    """Register `design` and `preview`."""
    sub = verbs.add("design", _design, "the most informative motion that the arm can safely make")
    sub.add_argument("arm", metavar="ARM", help="description file, or the name of a shipped one")
    sub.add_argument("--criterion", choices=_CRITERIA, help="default: the arm's")
    sub.add_argument(
        "--parameter",
        action="append",
        dest="chosen",
        metavar="EXPRESSION",
        help="a base parameter as `ident base` prints it, to be taught best (a_optimal); may be repeated",
    )
    sub.add_argument("--motion", choices=["fourier", "postures"], help="default: the arm's")
    length = "of the motion, ramps included: whole periods of about the base frequency (default: the arm's)"
    sub.add_argument("--length", type=seconds, metavar="SECONDS", help=length)
    sub.add_argument("--base-frequency", type=frequency, metavar="HZ")
    sub.add_argument("--harmonics", type=count, metavar="N")
    sub.add_argument("--periods", type=count, metavar="N")
    sub.add_argument("--ramp", type=weight, metavar="SECONDS", help="to swell from rest and to die down")
    sub.add_argument("--postures", type=count, metavar="N", help="for postures: how many")
    sub.add_argument("--position-margin", type=weight, metavar="RAD", help="kept free at every position limit")
    sub.add_argument("--torque-margin", type=share, metavar="SHARE", help="of every torque limit, kept free")
    _know(sub)
    sub.add_argument("--seed", type=seed, default=0, help="of the random starts")
    searched = "time for the search, not the motion's length (default: 60, or none with --starts)"
    sub.add_argument("--search-time", type=seconds, metavar="SECONDS", help=searched)
    sub.add_argument("--seconds", dest="search_time", type=seconds, help=argparse.SUPPRESS)  # former name
    sub.add_argument("--starts", type=count, metavar="N", help="random starts; the result is then the same every time")
    sub.add_argument("--workers", type=workers, default=2, metavar="N", help="processes")
    sub.add_argument("--resume", type=Path, metavar="FILE", help="search.json of an earlier design, to go on from")
    sub.add_argument("--out", type=Path, metavar="DIR", help="default: a new folder below the state folder")

    sub = verbs.add("preview", _preview, "what a motion asks of the arm, and what it will teach (exit code 3: refused)")
    sub.add_argument("arm", metavar="ARM", help="description file, or the name of a shipped one")
    sub.add_argument("motion", nargs="?", type=Path, metavar="MOTION", help="motion.json; default: the description's")
    _know(sub)
    sub.add_argument("--out", type=Path, metavar="DIR", help="also write the text and the drawings there")


def _know(sub: Parser) -> None:
    sub.add_argument(
        "--model", type=Path, metavar="FILE", help="parameters.json to predict torques with, not the prior"
    )
    sub.add_argument("--noise", type=Path, metavar="FILE", help="parameters.json whose residuals are the noise")
    sub.add_argument(
        "--after",
        action="append",
        default=[],
        type=Path,
        metavar="RECORDING",
        help="add to what this one taught; or FILE@41:60",
    )


def _knowledge(arguments: argparse.Namespace) -> Knowledge:
    from ident_service.operations.design import Knowledge

    return Knowledge(arguments.model, arguments.noise, tuple(arguments.after))


def _design(arguments: argparse.Namespace) -> Answer:
    import numpy as np

    from ident_service.config.load import load_arm
    from ident_service.excitation.search import Budget
    from ident_service.operations.design import FILES, DesignRequest, design_files
    from ident_service.operations.folders import new_run_folder
    from ident_service.operations.preview import preview_document
    from ident_service.operations.preview_text import preview_text

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
    folder = arguments.out or new_run_folder(own_state_folder(arguments), load_arm(arguments.arm).name, "motions")
    stopping = StopOnSignal()
    with stopping:
        designed, seen = design_files(request, folder, _progress(arguments), stopping.requested)
    _progress_end(arguments)
    unfinished = "" if designed.found.finished or request.resume else _UNFINISHED
    if unfinished:
        sys.stderr.write(f"ident: {unfinished}\n")
    taught = bool(np.isfinite(seen.deviations).any())
    binding = "".join(f"  {line}\n" for line in designed.binding)
    binding = f"what holds the motion back\n{binding}\n" if binding else ""
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
    return (VERDICT_NO if seen.objections or not taught else DONE), text, document


def _progress(arguments: argparse.Namespace) -> Callable[[Progress], None]:
    """Return a callback that shows search progress: one line rewritten on a terminal, else a new one every 10 s."""
    stream = sys.stderr
    last = [-10.0]

    def show(progress: Progress) -> None:
        best = "none yet" if progress.best is None else f"{progress.best:.4f}"
        left = f", about {progress.remaining:.0f} s left" if progress.remaining == progress.remaining else ""
        words = f"{progress.phase}: {progress.finished} starts, best {best}, {progress.elapsed:.0f} s{left}"
        if stream.isatty():
            stream.write(f"\r{words}\x1b[K")
            stream.flush()
        elif progress.elapsed - last[0] >= 10.0:
            last[0] = progress.elapsed
            tell(arguments, words)

    return show


def _progress_end(arguments: argparse.Namespace) -> None:
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")


def _preview(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.design import preview_files
    from ident_service.operations.preview import preview_document
    from ident_service.operations.preview_text import preview_text

    seen = preview_files(arguments.arm, arguments.motion, _knowledge(arguments), arguments.out)
    text = preview_text(seen)
    document = preview_document(seen)
    if arguments.out is not None:
        text += f"\nfiles: {arguments.out}\n"
        document["folder"] = str(arguments.out)
    return (VERDICT_NO if seen.objections else DONE), text, document
