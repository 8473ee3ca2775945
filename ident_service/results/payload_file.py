"""Present a payload as JSON validated by its schema, as text, and as the parameters of the arm that carries it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from copy import deepcopy
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ident_service import __version__
from ident_service.config.arm import ArmConfig, Body, FeasibleSetName, Mass
from ident_service.errors import ParameterError
from ident_service.estimation.certificate import certify
from ident_service.estimation.equations import Equations
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.feasible.problems import feasibility_test
from ident_service.estimation.least_squares import TorqueError, ordinary_least_squares
from ident_service.estimation.payload import KnownArm, Payload, Word, body_words, center_of_mass, loaded_covariance
from ident_service.estimation.uncertainty import negligible, verdicts
from ident_service.model.chain import Array
from ident_service.model.parameter_layout import INERTIAL
from ident_service.results.manifest import write_atomically
from ident_service.results.parameter_file import finite_or_none, information_document, require_schema
from ident_service.results.summary import rows_and_filter, wrapped

_WORDS: Mapping[Word, tuple[str, str]] = {
    "none": ("NO PAYLOAD", "the arm moves as it was identified"),
    "added": ("ADDED", "a body was added to the last link"),
    "removed": ("REMOVED", "a body was removed from the last link"),
    "infeasible": (
        "INFEASIBLE",
        "no single added or removed body explains the recording; after a change of tools identify the arm again, "
        "or compare: friction or the arm itself may have changed (`ident compare`)",
    ),
}
_ROUNDING = 1e-12  # of the largest value of a quantity; less is printed as zero
# Entries that no longer hold for an arm with a load, or are about other recordings.
_OF_ARM_ALONE = (
    "white_standard_deviations",
    "noise_standard_deviations",
    "constrained_intervals",
    "unconstrained_values",
)
_STALE = ("bootstrap", "essential", "recording_quality", "validation", "fit", "information", "link_parameters")


def payload_document(payload: Payload, arm: KnownArm, arm_sha256: str, recordings: Sequence[Mapping[str, str]]) -> Any:
    """Return the content of `payload.json`.

    Args:
        payload: identified payload.
        arm: arm that carries it.
        arm_sha256: hash of the arm's parameter file.
        recordings: name and sha256 of each.
    """
    base, center = payload.base, center_of_mass(payload)
    body = payload.body
    return {
        "format": "ident-payload",
        "version": 1,
        "verdict": payload.verdict,
        "arm": {"name": arm.model.config.name, "parameters_sha256": arm_sha256},
        "link": arm.model.layout.joints,
        "base_parameters": {
            "expressions": list(base.expressions),
            "units": list(base.units),
            "values": payload.fit.beta.tolist(),
            "standard_deviations": finite_or_none(payload.standard_deviations),
            "covariance": [finite_or_none(row) for row in payload.covariance],
            "verdicts": list(payload.verdicts),
        },
        "center_of_mass": None
        if center is None
        else {"values": center[0].tolist(), "standard_deviations": center[1].tolist()},
        "body": None
        if body is None
        else {
            "names": list(base.names[: len(INERTIAL)]),
            "values": body.delta[: len(INERTIAL)].tolist(),
            "verdicts": list(body_words(payload)),
            "margin": body.margin,
            "p": body.p,
            "torque_share": body.torque_share.tolist(),
            "certificate": _certificate(payload),
        },
        "test": {
            "sigma": payload.test.sigma,
            "directions": payload.test.directions,
            "degrees_of_freedom": payload.test.degrees if np.isfinite(payload.test.degrees) else None,
            "p": payload.test.p,
        },
        "torque_share": payload.torque_share.tolist(),
        "residual_over_identified": None if payload.excess is None else payload.excess.tolist(),
        "relative_error_percent": {
            "without": payload.without.relative_percent,
            "fitted": payload.fitted.relative_percent,
        },
        "recordings": [dict(one) for one in recordings],
        "software": f"ident-service {__version__}",
    }


def _certificate(payload: Payload) -> dict[str, Any] | None:
    """Return the proof that the body's own base parameters are those of a real body; None without a body."""
    if payload.body is None:
        return None
    base, delta = payload.base, payload.body.delta
    return certify(base.K @ delta, base, feasible_set("pseudo_inertia", base.names), delta).document


def write_payload(path: Path, document: Any) -> None:
    """Write the content of `payload.json` to the file `path`, after validating it against the schema.

    Raises:
        ParameterError: the document does not fit the schema.
        UsageError: the file cannot be written.
    """
    require_schema(document, "payload", path, "a payload")
    write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def payload_text(payload: Payload, arm: KnownArm) -> str:
    """Describe a payload in several lines of plain text, ending with a line break."""
    word, meaning = _WORDS[payload.verdict]
    names, test = arm.model.chain.names, payload.test
    lines = [
        f"{word}: {meaning}",
        f"against no payload: {test.sigma:.3g} sigma in {test.directions} directions, p = {test.p:.2g}",
        f"torque error on all rows of the recording: {payload.without.relative_percent:.3f} % with the arm as "
        f"identified, {payload.fitted.relative_percent:.3f} % with the payload (eq. 84)",
    ]
    if payload.excess is not None and (far := payload.far()):
        worst = max(far, key=lambda joint: payload.excess[joint])  # type: ignore[index]
        lines.append(
            f"the residual is {payload.excess[worst]:.0f} times as large at joint {names[worst]} as when the arm was "
            "identified: friction, the arm or the recording has changed in a way that no body explains"
        )
    lines += [
        f"  joint {name}: {share:.2%} of its torque" for name, share in zip(names, payload.torque_share, strict=True)
    ]
    lines += ["", f"in the frame of link {arm.model.layout.joints} (minus: taken off), without constraints"]
    rows = zip(
        payload.base.expressions,
        payload.fit.beta,
        payload.standard_deviations,
        payload.verdicts,
        payload.base.units,
        strict=True,
    )
    lines += [
        f"  {name:30s} {value:11.4g} +- {sigma:8.2g}  {verdict} [{unit}]" for name, value, sigma, verdict, unit in rows
    ]
    excited = {name for row in payload.base.K for name, value in zip(payload.base.names, row, strict=True) if value}
    if hidden := [name for name in payload.base.names if name not in excited]:
        lines.append(f"  not excited by any motion of this arm: {' '.join(hidden)}")
    if (center := center_of_mass(payload)) is not None and payload.verdict in ("added", "removed"):
        point = ", ".join(f"{value:.4g} +- {sigma:.2g}" for value, sigma in zip(*center, strict=True))
        lines.append(f"  centre of mass [m]: {point}")
    if payload.body is not None:
        worst = int(np.argmax(payload.body.torque_share))
        lines += [
            "",
            f"the nearest physical body, p = {payload.body.p:.2g}, at most {payload.body.torque_share[worst]:.2%} of "
            f"the torque of joint {names[worst]} away",
        ]
        values, words = without_rounding_errors(payload.body.delta[: len(INERTIAL)]), body_words(payload)
        body = [f"{name} {value:.4g}" for name, value in zip(payload.base.names, values, strict=False)]
        shown = [text for text, word in zip(body, words, strict=True) if word != "chosen"]
        lines.append("  " + "  ".join(shown))
        if len(shown) < len(body):
            chosen = "  ".join(text for text, word in zip(body, words, strict=True) if word == "chosen")
            lines.append(f"  not identified, chosen as a compact load of this mass has them: {chosen}")
    lines += ["", *wrapped(rows_and_filter(arm.model.config.identification))]
    return "\n".join(lines) + "\n"


def without_rounding_errors(values: Array) -> Array:
    """Return a body's ten parameters, zero for those that are only rounding beside the largest of their quantity."""
    shown = np.array(values, dtype=float)
    for quantity in (slice(0, 6), slice(6, 9), slice(9, 10)):
        part = shown[quantity]
        part[np.abs(part) < _ROUNDING * np.abs(part).max()] = 0.0
    return shown


def loaded_config(config: ArmConfig) -> ArmConfig:
    """Return the arm's description without the bounds on its last link and total mass, which the load changes."""
    joints = dict(config.joints)
    if joints:
        last = list(joints)[-1]
        joints[last] = joints[last].model_copy(update={"body": Body()})
    constraints = config.constraints.model_copy(update={"total_mass": Mass()})
    return config.model_copy(update={"joints": joints, "constraints": constraints})


def loaded_parameters(
    content: Mapping[str, Any],
    arm: KnownArm,
    payload: Payload,
    payload_equations: Equations,
    recordings: Sequence[Mapping[str, str]],
) -> tuple[dict[str, Any], Array | None]:
    """Return (`parameters.json` of the arm with its payload, link parameters (layout.size,); None if none feasible).

    Args:
        content: content of the arm's parameter file.
        arm: the arm as it was identified.
        payload: payload with a body.
        payload_equations: equations of the second recording.
        recordings: name and sha256 of each.

    Returns:
        The document, and the link parameters; None where no arm of real bodies has these base parameters.

    Raises:
        ParameterError: there is no body.
        SolverError: the solver stopped without an optimum.
    """
    if payload.body is None:
        raise ParameterError(f"the verdict is {payload.verdict}: there is no body to put on the arm")
    base, layout, config = arm.base, arm.model.layout, loaded_config(arm.model.config)
    kind: FeasibleSetName = "inertia" if content.get("feasible_set") == "inertia" else "pseudo_inertia"
    conditions = feasible_set(kind, base.names, config)
    beta, delta = arm.beta + payload.T @ payload.body.b, _moved(content, arm, payload)
    if delta is None or conditions.margin(delta)[0] <= 0.0:
        test = feasibility_test(beta, base, conditions)
        delta = test.delta if test.feasible else None
    margin = conditions.margin(delta)[0] if delta is not None else test.margin
    if delta is not None:
        beta = base.K @ delta
    proof = certify(beta, base, conditions, delta)
    covariance = loaded_covariance(arm, payload)
    deviations = np.sqrt(np.diag(covariance)) * _deviation_factors(content)
    as_zero = negligible(payload_equations.everything)
    document = {key: deepcopy(value) for key, value in content.items() if key not in _STALE}
    table = document["base_parameters"]
    for stale in _OF_ARM_ALONE:
        table.pop(stale, None)
    table |= {
        "values": beta.tolist(),
        "units": list(base.units) if any(base.units) else table.get("units", list(base.units)),
        "standard_deviations": finite_or_none(deviations),
        "covariance": [finite_or_none(row) for row in covariance],
        "negligible": finite_or_none(as_zero),
        "verdicts": list(verdicts(beta, deviations, as_zero)),
    }
    condition = ordinary_least_squares(payload_equations.total).condition_number
    document |= {
        "arm": {"name": config.name, "joints": list(arm.model.chain.names), "sha256": config.sha256},
        "feasible_set": kind if delta is not None else "none",
        "feasibility": {"feasible": proof.verdict == "feasible", "margin": margin, "certificate": proof.document},
        "fit": {
            "samples": payload_equations.samples,
            "blocks": min(payload.blocks, arm.blocks or payload.blocks),
            "condition_number": condition if np.isfinite(condition) else None,
            **_errors(payload.fitted, arm.model.chain.names),
        },
        "information": information_document(payload_equations.total),
        "provenance": {
            "recordings": [dict(one) for one in recordings],
            "software": f"ident-service {__version__}",
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        },
    }
    if delta is not None:
        document["link_parameters"] = {
            "names": list(layout.names),
            "units": list(layout.units),
            "values": delta.tolist(),
        }
    return document, delta


def _moved(content: Mapping[str, Any], arm: KnownArm, payload: Payload) -> Array | None:
    """Return the arm's own link parameters with the body added to, or taken off, the last one."""
    table = content.get("link_parameters")
    if table is None or payload.body is None or tuple(table["names"]) != arm.base.names:
        return None
    delta = np.array(table["values"], dtype=float)
    sign = 1.0 if payload.verdict == "added" else -1.0
    index = {name: place for place, name in enumerate(arm.base.names)}
    for name, value in zip(payload.base.names, payload.body.delta, strict=True):
        delta[index[name]] += sign * value
    return delta


def _deviation_factors(content: Mapping[str, Any]) -> Array:
    """Return the factors by which the arm's standard deviations exceed those of its covariance, shape (base,)."""
    table = content["base_parameters"]
    told = np.array([np.inf if one is None else one for one in table["standard_deviations"]], float)
    variances = np.array([np.inf if row[k] is None else row[k] for k, row in enumerate(table["covariance"])], float)
    known = np.isfinite(told) & np.isfinite(variances) & (variances > 0.0)
    return np.asarray(np.maximum(1.0, np.where(known, told, 1.0) / np.sqrt(np.where(known, variances, 1.0))))


def _errors(error: TorqueError, names: tuple[str, ...]) -> dict[str, Any]:
    rows = zip(names, error.joint_relative_percent.tolist(), error.joint_rms.tolist(), strict=True)
    per_joint = [{"joint": name, "relative_error_percent": relative, "rms": rms} for name, relative, rms in rows]
    return {"relative_error_percent": error.relative_percent, "per_joint": per_joint}
