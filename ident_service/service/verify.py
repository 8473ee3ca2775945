"""Verification of a parameter file's certificate: reads the file, asks the exact verifier. Standard library only."""

from __future__ import annotations

from pathlib import Path

from ident_service.errors import UsageError
from ident_service.estimation.proof.certificate_exact import Verification, verify
from ident_service.estimation.proof.certificate_reader import MAX_CHARACTERS


def verify_file(path: Path) -> Verification:
    """Check the certificate of a parameter file in exact arithmetic.

    Args:
        path: the file.

    Raises:
        UsageError: no such file, or one that cannot be read.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_CHARACTERS + 1)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from None
    try:
        return verify(content.decode("utf-8"))
    except UnicodeDecodeError:
        return Verification("failed", "not a parameter file: not UTF-8")
