"""How an arm's recordings lie in files, and the gears between its motors and its joints.

With `r` the motor's turns per turn of the joint, `C` the coupling and `q0` the offsets: `q_motor = diag(r) C (q - q0)`,
hence `dq_motor = diag(r) C dq`, and since what the motors put in the joints give out (`tau_motor . dq_motor =
tau . dq`), `tau = C^T diag(r) tau_motor`. Boundary: data and its own consistency; `record/transmission.py` computes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from ident_service.config.quantities import Angle, NonNegative, Number, Positive, Section

# Beyond, rounding would eat half of the digits on the way from motor to joint.
_WORST_CONDITION = 1e8
_NUMBERED = re.compile(r"(q|dq|tau)(\d+)")

ColumnName = Annotated[str, Field(pattern=r"^(t|(q|dq|tau)[1-9]\d{0,3})$")]


class Transmission(Section):
    """Gear ratios per joint (motor over joint, the sign tells the sense), coupling of joints, offsets of zero.

    `drive_terms` says whose drive inertia and friction are: those of the motors, which a coupling spreads over joints,
    or those of the joints as if there were no coupling, as in the paper's model of the WAM.
    """

    ratios: Annotated[tuple[Number, ...], Field(min_length=1)]
    coupling: tuple[tuple[Number, ...], ...] | None = None
    offsets: tuple[Angle, ...] | None = None
    drive_terms: Literal["motors", "joints"] = "motors"

    @field_validator("ratios")
    @classmethod
    def _turning(cls, ratios: tuple[float, ...]) -> tuple[float, ...]:
        if 0.0 in ratios:
            raise ValueError("a ratio of zero moves nothing")
        return ratios

    @field_validator("coupling")
    @classmethod
    def _invertible(
        cls, coupling: tuple[tuple[float, ...], ...] | None, info: ValidationInfo
    ) -> tuple[tuple[float, ...], ...] | None:
        if coupling is None or "ratios" not in info.data:
            return coupling
        size = len(info.data["ratios"])
        if len(coupling) != size or any(len(row) != size for row in coupling):
            raise ValueError(f"{size} ratios need {size} rows of {size} numbers")
        if not np.linalg.cond(np.array(coupling)) < _WORST_CONDITION:
            raise ValueError("the matrix has no inverse, so that no joint position follows from the motors'")
        return coupling

    @field_validator("offsets")
    @classmethod
    def _one_each(cls, offsets: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        if offsets is not None and "ratios" in info.data and len(offsets) != len(info.data["ratios"]):
            raise ValueError(f"{len(offsets)} offsets for {len(info.data['ratios'])} ratios")
        return offsets


class RecordingFormat(Section):
    """How an arm's recordings are read; `columns`, `joint_names`, `topic`, `side` are for the files of others only.

    `columns` gives a CSV file's own name for each of `t` [s], `q1`, `tau1` and optionally `dq1`; `joint_names` a
    JointState's own name for a joint of the arm. `side` says where positions and torques were measured. Irregular
    `stamps` are either when each sample was taken (`sampled`), or when the sample arrived (`arrival`) although it was
    taken on time: then the samples count as evenly spaced between gaps. `trim` [s] is cut off at start and end; a step
    of more than `gap` usual periods is a gap; `rate` [Hz] resamples.
    """

    columns: dict[ColumnName, str] = Field(default_factory=dict)
    joint_names: dict[str, str] = Field(default_factory=dict)
    topic: Annotated[str, Field(min_length=1)] = "/joint_states"
    side: Literal["joint", "motor"] = "joint"
    stamps: Literal["sampled", "arrival"] = "sampled"
    trim: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    gap: Annotated[float, Field(gt=1, strict=True)] = 3.0
    rate: Positive | None = None

    @field_validator("columns")
    @classmethod
    def _complete(cls, columns: dict[str, str]) -> dict[str, str]:
        if not columns:
            return columns
        _once("column", columns)
        joints = _joints(columns)
        wanted = ["t", *(f"{kind}{k}" for kind in ("q", "tau") for k in range(1, joints + 1))]
        if any(name.startswith("dq") for name in columns):
            wanted += [f"dq{k}" for k in range(1, joints + 1)]
        if missing := [name for name in wanted if name not in columns]:
            raise ValueError(f"no column for {', '.join(missing)}")
        if joints == 0:
            raise ValueError("no joints")
        return columns

    @field_validator("joint_names")
    @classmethod
    def _distinct(cls, joint_names: dict[str, str]) -> dict[str, str]:
        _once("name", joint_names)
        return joint_names


def _once(what: str, names: dict[str, str]) -> None:
    theirs = list(names.values())
    if twice := sorted({name for name in theirs if theirs.count(name) > 1}):
        raise ValueError(f"{what} {', '.join(map(repr, twice))} stands for more than one")


def _joints(columns: dict[str, str]) -> int:
    return max((int(match[2]) for name in columns if (match := _NUMBERED.fullmatch(name))), default=0)


def disagreements(
    form: RecordingFormat, transmission: Transmission | None, joints: Sequence[str]
) -> Iterator[tuple[tuple[str, ...], str]]:
    """What does not fit together in an arm of these joints: the place in the arm's file, and what is wrong.

    Args:
        form: the section `recording`.
        transmission: the section `transmission`.
        joints: names of the arm's joints; none where the file does not name them.
    """
    if form.side == "motor" and transmission is None:
        yield ("recording", "side"), "recording.side: motor, but there is no transmission"
    if not joints:
        return
    if transmission is not None and len(transmission.ratios) != len(joints):
        yield (
            ("transmission", "ratios"),
            f"transmission.ratios: {len(transmission.ratios)} values for {len(joints)} joints",
        )
    if form.columns and _joints(form.columns) != len(joints):
        yield (
            ("recording", "columns"),
            f"recording.columns: {_joints(form.columns)} joints, but the arm has {len(joints)}",
        )
    for name in form.joint_names:
        if name not in joints:
            yield ("recording", "joint_names", name), f"recording.joint_names: no joint {name!r}"
