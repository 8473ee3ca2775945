"""Export an identified arm in several formats at once: all files appear, or none; CSV and JSON are written here.

Bodies and placements are as pinocchio takes them, so that a dozen lines load the file into it (`docs/exports.md`).

What each format carries is said where it is written; what of this arm it did not carry comes with the answer.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ident_service import __version__
from ident_service.config.arm import Joint
from ident_service.errors import ModelError, MustNotBeUsed, UsageError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.friction_state import presliding_distances
from ident_service.model.parameter_layout import INERTIAL, Layout, about_center
from ident_service.model.regressor import joint_regressor
from ident_service.results.export.bodies import about_origin, joint_bodies
from ident_service.results.export.c_header import c_header, c_prefix, presliding_notes
from ident_service.results.export.identified_arm import IdentifiedArm, read_identified
from ident_service.results.export.mjcf import mjcf_export
from ident_service.results.export.round_trip import AGREEMENT, disagreement, random_states, torque
from ident_service.results.export.sdf import sdf_export
from ident_service.results.export.urdf import urdf_export
from ident_service.results.manifest import atomic_folder, write_atomically

# Standard deviations are those of the unconstrained values; both are the same where nothing was constrained.
_HEADER = ("kind", "name", "unit", "value", "sigma", "verdict", "unconstrained_value")
_LEAST_MASS = 1e-3  # [kg]


def csv_export(arm: IdentifiedArm, file_name: str) -> str:
    """Return all parameters as the text of a CSV table, with all digits; errors name the file as `file_name`.

    Args:
        arm: arm, with link parameters or without.
        file_name: name of the file, for errors.

    Raises:
        ModelError: the table read back differs.
    """
    base, layout = arm.base, arm.model.layout
    sigma = ("" if deviation is None else repr(float(deviation)) for deviation in arm.sigma)
    free = [""] * base.size if arm.unconstrained is None else [repr(float(value)) for value in arm.unconstrained]
    rows = [("do not use", reason, "", "", "", "", "") for reason in arm.forbidden]
    rows += [
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
    found = [row["value"] for row in csv.DictReader(io.StringIO(text.getvalue()))][len(arm.forbidden) :]
    meant = [*arm.beta.tolist(), *([] if arm.delta is None else arm.delta.tolist()), *(value for *_, value in shape)]
    if [float(value) for value in found] != meant:
        raise ModelError(f"{file_name}: the table read back differs from the parameters; it was not written")
    return text.getvalue()


def _friction_shape(arm: IdentifiedArm) -> list[tuple[str, str, float]]:
    """Return the nonlinear friction numbers, joint by joint: name, unit, value; none that the arm has not."""
    model, layout = arm.model, arm.model.layout
    units = ["rad" if turns else "m" for turns in model.chain.revolute]
    ways = presliding_distances(model).tolist()
    found = [(f"presliding{k}", unit, way) for k, (unit, way) in enumerate(zip(units, ways, strict=True), 1)]
    found = found if any(ways) else []
    if "stribeck" in layout.terms:
        velocities = enumerate(zip(units, layout.stribeck_velocity, strict=True), 1)
        found += [(f"stribeck_velocity{k}", f"{unit}/s", float(velocity)) for k, (unit, velocity) in velocities]
    return found


_FORMAT, _VERSION = "ident-dynamics", 1


def json_export(arm: IdentifiedArm, file_name: str) -> str:
    """Return the arm as JSON; ModelError unless the same torques can be computed from it.

    Args:
        arm: arm, with link parameters or without.
        file_name: name of the file, for errors.

    Raises:
        ModelError: a link without positive mass, or the file does not say what it should.
    """
    text = json.dumps(_document(arm), indent=1, allow_nan=False) + "\n"
    _check(arm, text, file_name)
    return text


def _document(arm: IdentifiedArm) -> dict[str, Any]:
    model, layout = arm.model, arm.model.layout
    chain = model.chain
    bodies = None if arm.delta is None else joint_bodies(model, arm.delta)
    joints = []
    for k, name in enumerate(chain.names):
        settings = model.config.joints.get(name, Joint())
        joints.append(
            {
                "name": name,
                "type": "revolute" if chain.revolute[k] else "prismatic",
                "parent": chain.parents[k],
                "placement": {"rotation": chain.rotation[k].tolist(), "translation": chain.translation[k].tolist()},
                "axis": chain.axes[k].tolist(),
                "limits": {
                    "position": settings.position,
                    "velocity": settings.velocity,
                    "torque": settings.torque,
                },
                "body": None if bodies is None else _body(bodies[k]),
            }
        )
    delta = arm.base_delta if arm.delta is None else arm.delta
    drives: dict[str, list[float]] = {term: layout.term_values(term, delta).tolist() for term in layout.terms}
    if "stribeck" in layout.terms:
        drives["stribeck_velocity"] = list(layout.stribeck_velocity)
    return {
        "format": _FORMAT,
        "version": _VERSION,
        "arm": model.config.name,
        "software": f"ident-service {__version__}",
        "parameters_sha256": arm.source,
        "unusable": list(arm.forbidden),
        "notes": [*body_notes(arm), *filter(None, (arm.deviations_note,))],
        "units": "SI: m, rad, kg, s, N m; torque positive along the joint's axis",
        "gravity": chain.gravity.tolist(),
        "joints": joints,
        "friction": {
            "presliding": presliding_distances(model).tolist(),
            "stribeck_velocity": list(layout.stribeck_velocity),
        },
        "drives": None if arm.delta is None else {"coupling": chain.coupling.tolist(), **drives},
        "base_parameters": {
            "expressions": list(arm.base.expressions),
            "units": list(arm.base.units),
            "values": arm.beta.tolist(),
            "unconstrained_values": None if arm.unconstrained is None else arm.unconstrained.tolist(),
            "standard_deviations": list(arm.sigma),
            "verdicts": list(arm.verdicts),
        },
    }


def _body(parameters: Array) -> dict[str, Any]:
    mass, center, inertia = about_center(parameters)
    return {"mass": mass, "center_of_mass": center.tolist(), "inertia": inertia.tolist()}


def _check(arm: IdentifiedArm, text: str, name: str) -> None:
    """Build the arm from the text, and check its values and torques."""
    content = json.loads(text)
    if content["base_parameters"]["values"] != arm.beta.tolist():
        raise ModelError(f"{name}: the base parameters read back differ; it was not written")
    if content["friction"]["presliding"] != presliding_distances(arm.model).tolist():
        raise ModelError(f"{name}: the pre-sliding distances read back differ; it was not written")
    if arm.delta is None:
        return
    joints, drives, n = content["joints"], dict(content["drives"]), len(content["joints"])
    revolute = tuple(joint["type"] == "revolute" for joint in joints)
    chain = Chain(
        names=tuple(joint["name"] for joint in joints),
        parents=tuple(joint["parent"] for joint in joints),
        revolute=revolute,
        axes=np.array([joint["axis"] for joint in joints]),
        rotation=np.array([joint["placement"]["rotation"] for joint in joints]),
        translation=np.array([joint["placement"]["translation"] for joint in joints]),
        link_rotation=np.tile(np.eye(3), (n, 1, 1)),
        link_translation=np.zeros((n, 3)),
        gravity=np.array(content["gravity"]),
        coupling=np.array(drives.pop("coupling")),
    )
    layout = Layout(revolute, tuple(key for key in arm.model.layout.terms), tuple(drives.pop("stribeck_velocity", ())))
    delta = np.zeros((n, layout.per_link))
    for k, joint in enumerate(joints):
        body = joint["body"]
        inertia = np.array(body["inertia"])
        delta[k, : len(INERTIAL)] = about_origin(body["mass"], np.array(body["center_of_mass"]), inertia)
    for term in layout.terms:
        delta[:, len(INERTIAL) + layout.terms.index(term)] = drives[term]
    states = random_states(n)
    found = np.einsum("jps,p->sj", joint_regressor(chain, layout, *states), delta.ravel())
    if chain.names != arm.model.chain.names or min(chain.parents) < WORLD:
        raise ModelError(f"{name}: the joints read back differ; it was not written")
    if not disagreement(found, torque(arm.model, arm.delta, states)) <= AGREEMENT:
        raise ModelError(f"{name}: the torques read back differ from the parameters'; it was not written")


@dataclass(frozen=True)
class Export:
    """File of an export, with the data that it does not carry.

    Attributes:
        format: name of the format, one of `FORMATS`.
        name: of the file.
        text: content of the file.
        not_carried: parts of the arm that the format has no place for, in words.
        notes: further notes for the reader.
    """

    format: str
    name: str
    text: str
    not_carried: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


_BASE_ONLY = "not feasible: base parameters only"


def _urdf(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.urdf"
    said = _said(arm)
    text, lost, notes = urdf_export(arm.model, arm.body(), name, said, arm.motion)
    return Export("urdf", name, text, lost, (*notes, *said))


def _mjcf(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.xml"
    said = _said(arm)
    text, lost = mjcf_export(arm.model, arm.body(), name, said, arm.motion)
    return Export("mjcf", name, text, lost, said)


def _sdf(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.sdf"
    said = _said(arm)
    text, lost, notes = sdf_export(arm.model, arm.body(), name, said, arm.motion)
    return Export("sdf", name, text, lost, (*notes, *said))


def _json(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.json"
    return Export("json", name, json_export(arm, name), notes=_notes(arm))


def _csv(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.csv"
    lost = ("kinematics",)
    return Export("csv", name, csv_export(arm, name), lost, _notes(arm))


def _c(arm: IdentifiedArm) -> Export:
    notes = (arm.forbidden_note, *presliding_notes(arm), arm.deviations_note)
    return Export("c", f"{c_prefix(arm)}_dynamics.h", c_header(arm), notes=tuple(filter(None, notes)))


def _notes(arm: IdentifiedArm) -> tuple[str, ...]:
    """Return the notes of the formats with base and link values."""
    notes = (_BASE_ONLY,) if arm.delta is None else body_notes(arm)
    return tuple(filter(None, (arm.forbidden_note, *notes, arm.deviations_note)))


def _said(arm: IdentifiedArm) -> tuple[str, ...]:
    """Return the notes of the formats with link values, which are comments in the file too."""
    return (*filter(None, (arm.forbidden_note,)), *body_notes(arm))


FORMATS: dict[str, Callable[[IdentifiedArm], Export]] = {
    "urdf": _urdf,
    "mjcf": _mjcf,
    "sdf": _sdf,
    "json": _json,
    "csv": _csv,
    "c": _c,
}


def known_formats(format_list: str) -> tuple[str, ...]:
    """Parse the names of formats in a list with commas, each once; raise UsageError for unknown ones or none.

    Raises:
        UsageError: none, or one that is not there.
    """
    named = tuple(dict.fromkeys(word.strip() for word in format_list.split(",") if word.strip()))
    if unknown := [word for word in named if word not in FORMATS]:
        raise UsageError(f"no export format {', '.join(map(repr, unknown))}: formats are {', '.join(FORMATS)}")
    if not named:
        raise UsageError(f"no export format given: formats are {', '.join(FORMATS)}")
    return named


def export_texts(arm: IdentifiedArm, formats: Sequence[str]) -> tuple[Export, ...]:
    """Return the files of an export as texts, unwritten, each read back and found to say what the parameters say.

    Raises:
        UsageError: no such format.
        ModelError: a format cannot carry the arm, the message says why.
    """
    return tuple(FORMATS[name](arm) for name in known_formats(",".join(formats)))


def export_run(
    results_folder: Path,
    formats: Sequence[str],
    folder: Path,
    step: Callable[[str, float], None] = lambda words, share: None,
    *,
    anyway: bool = False,
) -> tuple[Export, ...]:
    """Export results into `folder`, all files or none, forbidden values only if `anyway`; return what was written.

    Args:
        results_folder: the folder, every file in it as its manifest says.
        formats: names of the formats, of `FORMATS`.
        folder: folder for the files; others in it stay.
        step: called with each format before it is made, and the share of them that is done, from 0 to 1.
        anyway: whether to export parameters that must not be used; every file is marked then.

    Returns:
        What was written, without the texts.

    Raises:
        UsageError: no such format or folder, or nothing can be written there.
        MustNotBeUsed: its parameters must not be, and they were not to be exported anyway.
        ParameterError: the files of the run are torn, changed or foreign.
        ConfigError, ModelError: the arm in it cannot be used, or a format cannot carry it.
    """
    arm, made = read_identified(results_folder), list[Export]()
    if arm.forbidden and not anyway:
        raise MustNotBeUsed(
            f"{results_folder}: must not be used: {'; '.join(reason.rstrip('.') for reason in arm.forbidden)}; nothing "
            "was exported; identify again and export that, or export it marked, with --anyway, where the folder is"
        )
    for name in known_formats(",".join(formats)):
        step(f"exporting {name}", len(made) / len(formats))
        made += export_texts(arm, [name])
    with atomic_folder(folder) as staging:
        for export in made:
            write_atomically(staging / export.name, export.text)
    return tuple(replace(export, text="") for export in made)


def body_notes(arm: IdentifiedArm) -> tuple[str, ...]:
    """Return notes for files with link values: one body of many, payload, implausible links; empty without such."""
    if arm.delta is None:
        return ()
    count, size = arm.verdicts.count("unidentified"), arm.base.size
    drawn = arm.model.config.identification.prior.kind != "none"
    how = "regularised towards the prior parameters" if drawn else "see option prior of ident identify"
    first = (
        f"link values are one feasible body of many with the same torques ({how}); "
        f"{count} of {size} base parameters are unidentified"
    )
    payload = arm.model.config.payload
    loaded = () if payload is None else (f"link values include the payload of the description: {payload.words}",)
    return (first, *loaded, *_implausible(arm.model, arm.delta))


def _implausible(model: ArmModel, delta: Array) -> tuple[str, ...]:
    farthest, found = arm_reach(model), []
    for name, parameters in zip(model.chain.names, joint_bodies(model, delta), strict=True):
        mass, center, _ = about_center(parameters)
        distance = float(np.linalg.norm(center))
        if mass < _LEAST_MASS:
            found.append(f"implausible: the link of {name} has a mass of {mass:.2g} kg")
        if distance > farthest:
            found.append(
                f"implausible: the link of {name} has its centre of mass {distance:.3g} m from its joint, and the arm "
                f"reaches {farthest:.3g} m"
            )
    return tuple(found)


def arm_reach(model: ArmModel) -> float:
    """Return the reach [m]: the longest way from the first joint, wherever mounted, along the frames and last link."""
    chain = model.chain
    ways = np.zeros(chain.joints)
    for k, parent in enumerate(chain.parents):
        before = 0.0 if parent == WORLD else ways[parent] + np.linalg.norm(chain.translation[k])
        ways[k] = before + _travel(model, k)
    return float(np.max(ways + np.linalg.norm(chain.link_translation, axis=1)))


def _travel(model: ArmModel, k: int) -> float:
    chain = model.chain
    if chain.revolute[k]:
        return 0.0
    joint = model.config.joints.get(chain.names[k])
    # A slide without limits reaches anywhere.
    return float(np.inf) if joint is None or joint.position is None else float(np.max(np.abs(joint.position)))
