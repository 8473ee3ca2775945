"""Describe the file format and units of an arm's recordings, and the gears between its motors and its joints.

With `r` the motor's turns per turn of the joint, `C` the coupling and `q0` the offsets: `q_motor = diag(r) C (q - q0)`,
hence `dq_motor = diag(r) C dq`, and since what the motors put in the joints give out (`tau_motor . dq_motor = tau .
dq`), `tau = C^T diag(r) tau_motor`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from ident_service.config.quantities import Angle, ExtendedSection, NonNegative, Number, Positive, Section

# Beyond it, rounding would lose half of the digits between motor and joint.
_WORST_CONDITION = 1e8
_FASTEST = 100_000.0  # Hz, of recordings; beyond, samples would fill any memory
_NUMBERED = re.compile(r"(q|dq|tau)(\d+)")
_SAME = 0.01  # a factor this near to a unit's own conversion is taken for a repetition of it

_QUANTITIES = {"t": "time", "q": "position", "dq": "velocity", "tau": "torque"}
_SI = {"time": "s", "position": "rad or m", "velocity": "rad/s or m/s", "torque": "N m or N"}
_TURN = 2.0 * math.pi
# Units with a fixed conversion to SI. Revolutions and degrees are for revolute joints, metres for prismatic ones.
_TURNING = {
    "position": {"rad": 1.0, "mrad": 1e-3, "deg": math.radians(1.0), "rev": _TURN},
    "velocity": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.radians(1.0), "rpm": _TURN / 60.0, "rev/s": _TURN},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3},
}
_SLIDING = {
    "position": {"m": 1.0, "mm": 1e-3},
    "velocity": {"m/s": 1.0, "mm/s": 1e-3},
    "torque": {"N": 1.0, "kN": 1e3},
}
_CONVERTED = {"time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}} | {
    quantity: _TURNING[quantity] | _SLIDING[quantity] for quantity in _TURNING
}
# Units that need an arm-specific factor, each with its size in the unit that the factor is given per.
_WITH_FACTOR = {
    "time": {"counts": (1.0, "count")},
    "position": {"counts": (1.0, "count")},
    "velocity": {"counts/s": (1.0, "count/s")},
    "torque": {"A": (1.0, "A"), "mA": (1e-3, "A"), "%": (0.01, "rated torque"), "counts": (1.0, "count")},
}

ColumnName = Annotated[str, Field(pattern=r"^(t|(q|dq|tau)[1-9]\d{0,3})$")]


def _name_alone_schema(schema: dict[str, Any]) -> None:
    """Describe that a column may be its name alone."""
    whole = dict(schema)
    schema.clear()
    schema["anyOf"] = [{"type": "string", "minLength": 1}, whole]


class Column(Section):
    """One column of a CSV file: its name in the file, and the conversion of its numbers to SI.

    The value is `factor` times the number converted from `unit`; both may be left out. A factor beside a unit that
    needs none is for what is left, a gear ratio or a sign.
    """

    model_config = ConfigDict(json_schema_extra=_name_alone_schema)

    column: Annotated[str, Field(min_length=1)]
    """Name of the column in the file."""
    unit: str | None = None
    """Unit of its numbers, such as `deg`, `rpm`, `mNm`, `A`, `%` or `counts`; SI when left out."""
    factor: Number = 1.0
    """Factor to SI, beside the unit's own [SI/unit]; negative turns the sign. Currents, counts and % of a rated torque
    need it: N m per A, rad per count, rated torque in N m."""

    @model_validator(mode="before")
    @classmethod
    def _by_name_alone(cls, value: Any) -> Any:
        return {"column": value} if isinstance(value, str) else value

    @field_validator("unit")
    @classmethod
    def _normalised_unit(cls, unit: str | None) -> str | None:
        return None if unit is None else re.sub(r"[\s*\u00b7]", "", unit).replace("\u00b5", "u")

    @field_validator("factor")
    @classmethod
    def _finite(cls, factor: float) -> float:
        if factor == 0.0:
            raise ValueError("a factor of zero makes every sample zero")
        return factor

    @model_serializer(mode="wrap")
    def _name_alone(self, serialized: SerializerFunctionWrapHandler) -> Any:
        # A plain name, so that descriptions without units keep the hash they had before units existed.
        return self.column if self.unit is None and self.factor == 1.0 else serialized(self)

    def si_factor(self, ident_column: str) -> float:
        """Return the factor from this column's numbers to SI; raises ValueError where its unit does not fit.

        Args:
            ident_column: name of the column in `ident`'s own files, such as `tau3`, which says the quantity.

        Raises:
            ValueError: an unknown unit, one of another quantity, one that needs a factor, or a factor that repeats
                the unit's own conversion.
        """
        quantity = _QUANTITIES[ident_column.rstrip("0123456789")]
        own, bare = _CONVERTED[quantity], _WITH_FACTOR[quantity]
        if quantity == "time" and self.factor < 0.0:
            raise ValueError(f"a factor of {self.factor:g} lets time run backwards")
        if self.unit is None:
            return self.factor
        if self.unit in bare:
            size, per = bare[self.unit]
            if "factor" not in self.model_fields_set:
                raise ValueError(f"unit {self.unit!r} needs a factor in {_SI[quantity]} per {per}")
            return self.factor * size
        if self.unit not in own:
            others = [other for other in _SI if self.unit in _CONVERTED[other] or self.unit in _WITH_FACTOR[other]]
            why = f"is a unit of {others[0]}, not of {quantity}" if others else "is not known"
            raise ValueError(f"unit {self.unit!r} {why}; known are {', '.join((*own, *bare))}")
        size = own[self.unit]
        if size != 1.0 and any(abs(abs(self.factor) / one - 1.0) < _SAME for one in (size, 1.0 / size)):
            raise ValueError(
                f"unit {self.unit!r} is converted by {size:g} already, and a factor of {self.factor:g} would repeat or "
                "undo it; leave out one of the two"
            )
        return self.factor * size


class Transmission(ExtendedSection):
    """Gear ratios, coupling of joints, and offsets of zero."""

    ratios: Annotated[tuple[Number, ...], Field(min_length=1)]
    """Turns of each motor per turn of its joint [1]; the sign tells the sense."""
    coupling: tuple[tuple[Number, ...], ...] | None = None
    """Matrix C of coupled joints [1]: `q_motor = diag(r) C (q - q0)`."""
    offsets: tuple[Angle, ...] | None = None
    """Joint positions at which the motors are at zero [rad or m]."""
    drive_terms: Literal["motors", "joints"] = "motors"
    """Drive inertia and friction are those of the motors, which a coupling spreads over joints, or those of the joints
    as if there were no coupling, as in the paper's model of the WAM."""
    motor_torque: tuple[Positive, ...] | None = None
    """Most that each motor gives [N m], where motors share joints and the driver's section does not say it."""
    later = frozenset({"motor_torque"})

    @property
    def coupling_matrix(self) -> NDArray[np.float64]:
        """Return the matrix `coupling`, or the identity where the description has none, shape (motors, joints)."""
        return np.eye(len(self.ratios)) if self.coupling is None else np.array(self.coupling)

    @field_validator("ratios")
    @classmethod
    def _require_nonzero_ratios(cls, ratios: tuple[float, ...]) -> tuple[float, ...]:
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

    @field_validator("offsets", "motor_torque")
    @classmethod
    def _require_one_per_ratio(cls, values: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        if values is not None and "ratios" in info.data and len(values) != len(info.data["ratios"]):
            what = "offsets" if info.field_name == "offsets" else "torques"
            raise ValueError(f"{len(values)} {what} for {len(info.data['ratios'])} ratios")
        return values

    @field_validator("motor_torque")
    @classmethod
    def _shared(cls, torque: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        coupling = info.data.get("coupling")
        if torque is not None and "ratios" in info.data and "coupling" in info.data:
            shared = coupling is not None and any(
                value for row, values in enumerate(coupling) for column, value in enumerate(values) if row != column
            )
            if not shared:
                raise ValueError("is for motors that share joints (coupling); else give joints.NAME.torque alone")
        return torque


def motor_groups(transmission: Transmission) -> NDArray[np.bool_]:
    """Return a mask of the motors that move each joint, directly or through other joints, shape (joints, motors)."""
    moves = transmission.coupling_matrix != 0.0
    found = moves.T
    for _ in transmission.ratios:
        found = found @ moves @ moves.T
    return np.asarray(found)


# Without positions, as long as a stall of this computer may last (decision 0069), or FIELDBUS.md's cycles.
_LONGEST_LOSS, _MOST_LOST = 0.010, 5  # s; cycles


def motor_disagreements(
    motors_name_and_key: tuple[str, str],
    motor_count: int,
    lost_cycles: int,
    transmission: Transmission | None,
    joints: Sequence[str],
    rate: float,
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield (key path, message): no `transmission`, wrong count of ratios or joints, too many `lost_cycles`.

    Args:
        motors_name_and_key: the motors' name, and their key in the section `driver`.
        motor_count: number of motors.
        lost_cycles: `driver.lost_cycles`.
        transmission: the arm's.
        joints: names of the arm's joints; none where the file does not name them.
        rate: cycles per second.
    """
    name, key = motors_name_and_key
    most = max(_MOST_LOST, _LONGEST_LOSS * rate)
    if lost_cycles > most:
        yield (
            ("driver", "lost_cycles"),
            f"driver.lost_cycles: {lost_cycles} at {rate:g} Hz is {1e3 * lost_cycles / rate:g} ms without positions;"
            f" at most {int(most)} cycles",
        )
    if transmission is None:
        yield ("driver",), f"{name} need the section transmission: gear ratios from joints to motors"
    elif len(transmission.ratios) != motor_count:
        yield ("driver", key), f"{motor_count} {key} but {len(transmission.ratios)} ratios in transmission"
    if joints and len(joints) != motor_count:
        yield ("driver", key), f"{motor_count} {key} for {len(joints)} joints"


class RecordingFormat(Section):
    """Format of an arm's recordings; `columns`, `joint_names`, `topic` and sides are for foreign files only."""

    columns: dict[ColumnName, Column] = Field(default_factory=dict)
    """Columns of a CSV file for `t`, `q1`, `tau1` and optionally `dq1`: its name, or name, unit and factor."""
    joint_names: dict[str, str] = Field(default_factory=dict)
    """A JointState's own name for a joint of the arm."""
    topic: Annotated[str, Field(min_length=1)] = "/joint_states"
    """Topic of joint states in a foreign MCAP file."""
    side: Literal["joint", "motor"] = "joint"
    """Side on which positions and velocities were measured, and torques where `torque_side` does not say."""
    torque_side: Literal["joint", "motor"] | None = None
    """Side on which torques were measured; `side` when left out."""
    stamps: Literal["sampled", "arrival"] = "sampled"
    """Irregular stamps are when each sample was taken (`sampled`), or when it arrived although it was taken on time
    (`arrival`): then samples count as evenly spaced between gaps."""
    trim: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Time cut off at start and end [s]."""
    gap: Annotated[float, Field(gt=1, strict=True)] = 3.0
    """Step that counts as a gap [usual periods]."""
    rate: Annotated[Positive, Field(le=_FASTEST)] | None = None
    """Rate that recordings are resampled at [Hz]; their own when left out."""
    missing: Literal["refuse", "skip"] = "refuse"
    """Samples with a missing value are refused, or left out and counted."""
    standstill: Literal["keep", "cut"] = "keep"
    """Standstill at the ends is kept, or cut."""

    @field_validator("columns")
    @classmethod
    def _complete(cls, columns: dict[str, Column]) -> dict[str, Column]:
        if not columns:
            return columns
        _once("column", {name: one.column for name, one in columns.items()})
        joints = _joints(columns)
        wanted = ["t", *(f"{kind}{k}" for kind in ("q", "tau") for k in range(1, joints + 1))]
        if any(name.startswith("dq") for name in columns):
            wanted += [f"dq{k}" for k in range(1, joints + 1)]
        if missing := [name for name in wanted if name not in columns]:
            raise ValueError(f"no column for {', '.join(missing)}")
        if joints == 0:
            raise ValueError("no joints")
        wrong = []
        for name, one in columns.items():
            try:
                one.si_factor(name)
            except ValueError as error:
                wrong.append(f"{name}: {error}")
        if wrong:
            raise ValueError("; ".join(wrong))
        return columns

    @model_serializer(mode="wrap")
    def _unless_default(self, serialized: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Left out at their defaults, so that older descriptions keep the hash that results store.
        document: dict[str, Any] = serialized(self)
        later = {"torque_side": None, "missing": "refuse", "standstill": "keep"}
        return {key: value for key, value in document.items() if key not in later or value != later[key]}

    @property
    def motor_sides(self) -> tuple[bool, bool]:
        """Return two flags: whether positions (and velocities), and whether torques, were measured at the motors."""
        return self.side == "motor", (self.torque_side or self.side) == "motor"

    @field_validator("joint_names")
    @classmethod
    def _require_distinct_names(cls, joint_names: dict[str, str]) -> dict[str, str]:
        _once("name", joint_names)
        return joint_names


def _once(what: str, names: dict[str, str]) -> None:
    theirs = list(names.values())
    if twice := sorted({name for name in theirs if theirs.count(name) > 1}):
        raise ValueError(f"{what} {', '.join(map(repr, twice))} stands for more than one")


def _joints(columns: Mapping[str, Column]) -> int:
    return max((int(match[2]) for name in columns if (match := _NUMBERED.fullmatch(name))), default=0)


def mismatched_units(
    recording_format: RecordingFormat, joints: Sequence[str], revolute: Sequence[bool]
) -> Iterator[str]:
    """Yield a message for each joint-side column whose unit is a prismatic joint's, for a revolute one, or vice versa.

    Quantities measured at a motor are rotary whatever the joint is, and are not checked.

    Args:
        recording_format: the section `recording`.
        joints: names of the arm's joints.
        revolute: mask of the revolute joints.
    """
    positions, torques = recording_format.motor_sides
    for name, one in recording_format.columns.items():
        match = _NUMBERED.fullmatch(name)
        if match is None or one.unit is None or int(match[2]) > len(joints):
            continue
        if torques if match[1] == "tau" else positions:
            continue
        joint, quantity = int(match[2]) - 1, _QUANTITIES[match[1]]
        if one.unit in (_SLIDING if revolute[joint] else _TURNING)[quantity]:
            yield (
                f"recording.columns.{name}: unit {one.unit!r}, but {joints[joint]} "
                f"{'turns' if revolute[joint] else 'slides'}; its {quantity} is in "
                f"{', '.join((_TURNING if revolute[joint] else _SLIDING)[quantity])}"
            )


def disagreements(
    recording_format: RecordingFormat, transmission: Transmission | None, joints: Sequence[str]
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield (key path, message) for each contradiction of section `recording` with transmission and joints.

    Args:
        recording_format: the section `recording`.
        transmission: the section `transmission`.
        joints: names of the arm's joints; none where the file does not name them.
    """
    for key, motors in zip(("side", "torque_side"), recording_format.motor_sides, strict=True):
        if motors and transmission is None and getattr(recording_format, key) == "motor":
            yield ("recording", key), f"recording.{key}: motor, but there is no transmission"
    if not joints:
        return
    if transmission is not None and len(transmission.ratios) != len(joints):
        yield (
            ("transmission", "ratios"),
            f"transmission.ratios: {len(transmission.ratios)} values for {len(joints)} joints",
        )
    if recording_format.columns and _joints(recording_format.columns) != len(joints):
        yield (
            ("recording", "columns"),
            f"recording.columns: {_joints(recording_format.columns)} joints, but the arm has {len(joints)}",
        )
    for name in recording_format.joint_names:
        if name not in joints:
            yield ("recording", "joint_names", name), f"recording.joint_names: no joint {name!r}"
