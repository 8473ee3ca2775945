"""Compare parameter sets from files and write the results, as `ident compare` does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ident_service.results.comparison.comparison import Comparison, compare
from ident_service.results.comparison.document import write_comparison
from ident_service.results.comparison.page import comparison_html
from ident_service.results.comparison.sides import read_side
from ident_service.results.comparison.text import comparison_text
from ident_service.results.files import appearing_folder, write_atomically
from ident_service.results.run_folder import write_manifest

DOCUMENT, TEXT, PAGE = "comparison.json", "comparison.txt", "comparison.html"
KEPT = (DOCUMENT, TEXT, PAGE)


def compare_files(paths: Sequence[Path], out: Path | None = None) -> tuple[Comparison, tuple[Path, ...]]:
    """Compare folders of results or parameter files; the first is the reference.

    Args:
        paths: two or more.
        out: a file that ends in `.json`, or a folder for everything; nothing is written when None.

    Returns:
        The comparison, and the files written.

    Raises:
        UsageError: fewer than two, one that is not there, or `out` cannot be written.
        ParameterError: one is torn, changed or foreign, or they have nothing in common.
        ConfigError: an arm in a folder is not one that this version reads.
    """
    comparison = compare([read_side(path) for path in paths])
    if out is None:
        return comparison, ()
    if out.suffix == ".json" and not out.is_dir():
        write_comparison(out, comparison)
        return comparison, (out,)
    with appearing_folder(out) as staging:
        names = write_comparison_files(staging, comparison)
    return comparison, tuple(out / name for name in names)


def compare_into(reference: Path, folder: Path) -> Comparison:
    """Compare a folder of results with a reference, and store the comparison in it, named by its manifest.

    A kill in between leaves files that the manifest does not name, and which are therefore ignored.

    Args:
        reference: folder of results or parameter file.
        folder: of results, verified here.

    Raises:
        UsageError, ParameterError, ConfigError: as `compare_files`.
    """
    comparison = compare([read_side(reference), read_side(folder)])
    write_comparison_files(folder, comparison)
    write_manifest(folder)
    return comparison


def write_comparison_files(folder: Path, comparison: Comparison) -> tuple[str, ...]:
    """Write a comparison in every form into a folder that exists; returns the names."""
    write_comparison(folder / DOCUMENT, comparison)
    write_atomically(folder / TEXT, comparison_text(comparison))
    write_atomically(folder / PAGE, comparison_html(comparison))
    return KEPT
