"""Write CSV, one parameter a row: base parameters, link parameters where a body has them, the shape of friction."""

from __future__ import annotations

import csv
import io

from ident_service.errors import ModelError
from ident_service.model.presliding import presliding_ways
from ident_service.results.export.arm import IdentifiedArm

# Standard deviations are those of the unconstrained values; both are the same where nothing was constrained.
_HEADER = ("kind", "name", "unit", "value", "sigma", "verdict", "unconstrained_value")


def csv_export(arm: IdentifiedArm, name: str) -> str:
    """Return all parameters as a table; numbers read back as the same ones.

    Args:
        arm: with link parameters or without.
        name: of the file, for errors.

    Raises:
        ModelError: the table read back differs.
    """
    base, layout = arm.base, arm.model.layout
    sigma = ("" if deviation is None else repr(float(deviation)) for deviation in arm.sigma)
    free = [""] * base.size if arm.unconstrained is None else [repr(float(value)) for value in arm.unconstrained]
    rows = [
        ("base", expression, unit, repr(float(value)), deviation, verdict, before)
        for expression, unit, value, deviation, verdict, before in zip(
            base.expressions, base.units, arm.beta, sigma, arm.verdicts, free, strict=True
        )
    ]
    shape = _friction_shape(arm)
    if arm.delta is not None:
        table = zip(layout.names, layout.units, arm.delta, strict=True)
        rows += [("link", parameter, unit, repr(float(value)), "", "", "") for parameter, unit, value in table]
    rows += [("friction shape", parameter, unit, repr(value), "", "", "") for parameter, unit, value in shape]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_HEADER, *rows])
    found = [row["value"] for row in csv.DictReader(io.StringIO(text.getvalue()))]
    meant = [*arm.beta.tolist(), *([] if arm.delta is None else arm.delta.tolist()), *(value for *_, value in shape)]
    if [float(value) for value in found] != meant:
        raise ModelError(f"{name}: the table read back differs from the parameters; it was not written")
    return text.getvalue()


def _friction_shape(arm: IdentifiedArm) -> list[tuple[str, str, float]]:
    """Return the nonlinear friction numbers, joint by joint: name, unit, value; none that the arm has not."""
    model, layout = arm.model, arm.model.layout
    units = ["rad" if turns else "m" for turns in model.chain.revolute]
    ways = presliding_ways(model).tolist()
    found = [(f"presliding{k}", unit, way) for k, (unit, way) in enumerate(zip(units, ways, strict=True), 1)]
    found = found if any(ways) else []
    if "stribeck" in layout.terms:
        velocities = enumerate(zip(units, layout.stribeck_velocity, strict=True), 1)
        found += [(f"stribeck_velocity{k}", f"{unit}/s", float(velocity)) for k, (unit, velocity) in velocities]
    return found
