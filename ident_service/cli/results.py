"""Register and run `report`, which makes the report page again, and `figures`, which writes its drawings as files."""

from __future__ import annotations

import argparse
from pathlib import Path

from ident_service.cli.answer import DONE, Answer
from ident_service.cli.words import Verbs


def add(verbs: Verbs) -> None:
    """Register `report` and `figures`."""
    sub = verbs.add("report", _report, "the report of a folder of results, as one page without network")
    sub.add_argument("run", type=Path, metavar="RUN", help="folder that `identify` or `simulate` made")
    sub.add_argument("--out", type=Path, metavar="FILE", help="default: report.html in the folder")

    sub = verbs.add("figures", _figures, "the drawings of a report as files, for papers and tickets")
    sub.add_argument("run", type=Path, metavar="RUN", help="folder that `identify` or `simulate` made")
    sub.add_argument("--format", choices=["svg", "png"], default="svg", help="png needs the extra `figures`")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="files of the same name are replaced")


def _report(arguments: argparse.Namespace) -> Answer:
    from ident_service.results.report_files import make_report

    page = make_report(arguments.run, arguments.out)
    size = page.stat().st_size
    return DONE, f"{page}: {size / 1e6:.2f} MB\n", {"file": str(page), "bytes": size}


def _figures(arguments: argparse.Namespace) -> Answer:
    from ident_service.results.figure_files import write_figures

    names = write_figures(arguments.run, arguments.out, arguments.format)
    text = f"files: {arguments.out}\n" + "".join(f"  {name}\n" for name in names)
    return DONE, text, {"folder": str(arguments.out), "files": names}
