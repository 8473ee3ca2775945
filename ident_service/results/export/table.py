"""CSV: one parameter a row, base parameters first, then the link parameters of a body that has them."""

from __future__ import annotations

import csv
import io

from ident_service.errors import ModelError
from ident_service.results.export.arm import IdentifiedArm

_HEADER = ("kind", "name", "unit", "value", "sigma", "verdict")


def csv_export(arm: IdentifiedArm, name: str) -> str:
    """All parameters as a table; numbers read back as the same ones.

    Args:
        arm: with link parameters or without.
        name: of the file, for errors.

    Raises:
        ModelError: the table read back differs.
    """
    base, layout = arm.base, arm.model.layout
    sigma = ("" if deviation is None else repr(float(deviation)) for deviation in arm.sigma)
    rows = [
        ("base", expression, unit, repr(float(value)), deviation, verdict)
        for expression, unit, value, deviation, verdict in zip(
            base.expressions, base.units, arm.beta, sigma, arm.verdicts, strict=True
        )
    ]
    if arm.delta is not None:
        table = zip(layout.names, layout.units, arm.delta, strict=True)
        rows += [("link", parameter, unit, repr(float(value)), "", "") for parameter, unit, value in table]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_HEADER, *rows])
    found = [row["value"] for row in csv.DictReader(io.StringIO(text.getvalue()))]
    meant = [*arm.beta.tolist(), *([] if arm.delta is None else arm.delta.tolist())]
    if [float(value) for value in found] != meant:
        raise ModelError(f"{name}: the table read back differs from the parameters; it was not written")
    return text.getvalue()
