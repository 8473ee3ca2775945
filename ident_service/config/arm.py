"""Describe an arm: mechanism, limits, gains, physical knowledge, driver, as checked configuration.

`yaml_source.py` and `load.py` read the YAML. SI units; angles in radians. Tables 2, 4, 5 and 7 and eqs. 25, 26, 28 of
Sousa & Cortesao 2014 have their place here.
"""

from __future__ import annotations

import hashlib
from typing import Annotated, Any, Literal

from pydantic import (
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)

from ident_service.config.barrett import BarrettDriver
from ident_service.config.can_bus import CanBus
from ident_service.config.canopen import CanopenDriver
from ident_service.config.control import Control, Realtime
from ident_service.config.kinematics import Kinematics
from ident_service.config.motion_design import Design, Geometry, Supply, Workspace
from ident_service.config.payload import Payload
from ident_service.config.quantities import (
    UPLOAD,
    Angle,
    Count,
    ExtendedSection,
    Interval,
    NonNegative,
    Number,
    ParameterTable,
    Positive,
    Section,
    Seed,
    Vector3,
)
from ident_service.config.recording import RecordingFormat, Transmission
from ident_service.config.simulation import SimulatedDriver


class PluginDriver(Section):
    """Driver that another distribution provides; it checks its own options."""

    model_config = ConfigDict(frozen=True, extra="allow")

    kind: str


def _driver_kind(value: Any) -> str:
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return kind if kind in ("simulated", "canopen", "barrett") else "plugin"


# Chosen by `kind`, so that a mistake in a built-in driver's section is not taken for a plug-in's options.
Driver = Annotated[
    Annotated[SimulatedDriver, Tag("simulated")]
    | Annotated[CanopenDriver, Tag("canopen")]
    | Annotated[BarrettDriver, Tag("barrett")]
    | Annotated[PluginDriver, Tag("plugin")],
    Discriminator(_driver_kind),
]


_BUILT_IN = (SimulatedDriver, CanopenDriver, BarrettDriver)

JointTerm = Literal["drive_inertia", "viscous", "coulomb", "offset", "stribeck", "quadratic", "viscous_asymmetry"]
FeasibleSetName = Literal["pseudo_inertia", "inertia"]
Method = Literal["ols", "wls", "huber", "iv"]


_FUNCTION = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*$"


class Box(Section):
    """An axis-aligned box in a link frame [m] (table 7)."""

    lower: Vector3
    upper: Vector3

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        for axis, lower, upper in zip("xyz", self.lower, self.upper, strict=True):
            if not lower < upper:
                raise ValueError(
                    f"{axis}: lower bound {lower:g} is not below upper bound {upper:g}; check order and units"
                )
        return self


class Ellipsoid(Section):
    """Ellipsoid in a link frame that contains all mass of the link: centre and half-axes [m].

    The rows of `axes` are unit vectors along the half-axes; those of the frame when left out.
    """

    center: Vector3
    semi_axes: tuple[Positive, Positive, Positive]
    axes: tuple[Vector3, Vector3, Vector3] | None = None

    @model_validator(mode="after")
    def _orthonormal(self) -> Ellipsoid:
        for i, one in enumerate(self.axes or ()):
            for j, other in enumerate(self.axes or ()):
                if abs(sum(a * b for a, b in zip(one, other, strict=True)) - float(i == j)) > 1e-6:
                    raise ValueError("axes are not three perpendicular unit vectors")
        return self


class Body(Section):
    """Prior knowledge about the link that a joint moves (eqs. 25, 26).

    Its mass, a box and a convex hull of points that its centre of mass lies in, an ellipsoid that all its mass lies in,
    and the coordinate planes of its frame that it is symmetric about.
    """

    mass: Interval | None = None
    center_of_mass: Box | None = None
    hull: Annotated[tuple[Vector3, ...], Field(min_length=4)] | None = None
    ellipsoid: Ellipsoid | None = None
    symmetry: tuple[Literal["xy", "yz", "xz"], ...] = ()


class Joint(ExtendedSection):
    """Limits, gains and body of one joint; what a motion needs may be left out of an arm that is only identified.

    `drive_inertia` [kg m^2 or kg] is what its rotors have at the joint by data sheet, the least that is there.
    Margins of the gains are stated with it where the prior, a CAD model of the links, lacks it. `brake` says whether a
    holding brake closes whenever the power stage is off. Where nothing is said, a simulated drive has one and a real
    one has none.
    """

    position: Interval | None = None
    velocity: Positive | None = None
    acceleration: Positive | None = None
    jerk: Positive | None = None
    torque: Positive | None = None
    following_error: Positive | None = None
    home: Angle | None = None
    kp: Positive | None = None
    kd: Positive | None = None
    drive_inertia: NonNegative | None = None
    brake: bool | None = None
    later = frozenset({"brake"})
    body: Body = Body()

    @model_validator(mode="after")
    def _home_inside(self) -> Joint:
        if (
            self.home is not None
            and self.position is not None
            and not self.position[0] <= self.home <= self.position[1]
        ):
            raise ValueError(f"home {self.home:g} lies outside position [{self.position[0]:g}, {self.position[1]:g}]")
        return self


class Mass(Section):
    """Bounds of the whole arm's mass [kg]; the moving links only."""

    lower: NonNegative = 0.0
    upper: Positive | None = None


class Constraints(ExtendedSection):
    """Physical knowledge about the whole arm (eqs. 25, 28).

    `torque_constant` bounds, per joint, what its measured torque must be multiplied by to be true; 1 elsewhere.
    `custom` names a Python function, `module:function`, that returns further constraints in cvxpy (docs/extending.md);
    the module stands beside the description or on PYTHONPATH. A description that is sent to a daemon must not name one.
    """

    total_mass: Mass = Mass()
    positive: tuple[Literal["drive_inertia", "viscous", "coulomb"], ...] = ("drive_inertia", "viscous", "coulomb")
    torque_constant: dict[str, tuple[Positive, Positive]] = Field(default_factory=dict)
    custom: Annotated[str, Field(pattern=_FUNCTION)] | None = None
    later = frozenset({"custom"})

    @field_validator("custom")
    @classmethod
    def _not_sent(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is not None and info.context is not None and UPLOAD in info.context:
            raise ValueError(
                "a description that is sent names no code; leave it out, or run `ident identify` at a terminal"
            )
        return value

    @model_validator(mode="after")
    def _ordered(self) -> Constraints:
        for joint, (lower, upper) in self.torque_constant.items():
            if not lower < upper:
                raise ValueError(
                    f"torque_constant of {joint}: lower bound {lower:g} is not below upper bound {upper:g}"
                )
        return self


class Smoothing(Section):
    """Zero-phase low-pass and derivatives (5.2.2).

    `butterworth` of `order`, or `savitzky_golay` polynomials of that degree over a window of about the same cut-off
    [Hz], chosen from the spectra of the positions by default. `filter_torque` sends the torque through the Butterworth
    filter too. `regressor_cutoff` [Hz] filters both sides of eq. 59 alike, the torque then no second time. `decimate`
    keeps every so many-th sample, after all filters; chosen, ten a period of the cut-off are left. `velocity` is the
    recording's own, or of the positions; by default the recording's where it has one that predicts better.
    """

    method: Literal["butterworth", "savitzky_golay"] = "butterworth"
    order: Annotated[Count, Field(le=8)] = 3
    cutoff: Positive | Literal["choose"] = "choose"
    filter_torque: bool = True
    regressor_cutoff: Positive | None = None
    decimate: Count | Literal["choose"] = "choose"
    velocity: Literal["position", "measured", "choose"] = "choose"

    @model_validator(mode="before")
    @classmethod
    def _filtered_once(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("regressor_cutoff") is not None:
            return {"filter_torque": False} | data
        return data


class Reversal(Section):
    """Rows of a joint near standstill: slower than `speed` [rad/s or m/s], or within `window` [s] of a reversal.

    Their friction is known less well than that of a joint in motion, and they count as their residuals allow.
    """

    speed: NonNegative = 0.05
    window: NonNegative = 0.2


class FrictionShape(Section):
    """Nonlinear friction parameters, per joint or one number for all, given or fitted (`fit`).

    `presliding` is the way [rad or m] over which friction turns round with the velocity (Dahl 1968), 0 for at once;
    `stribeck_velocity` [rad/s or m/s] is v_s of the term `stribeck`.
    """

    presliding: NonNegative | tuple[NonNegative, ...] | Literal["fit"] = "fit"
    stribeck_velocity: Positive | tuple[Positive, ...] | Literal["fit"] = "fit"


class PriorRegularisation(Section):
    """Regularisation of constrained estimates towards the prior (CAD) parameters: divergence and weight.

    `weight` is that of one unit of divergence against one residual variance, or `held_out`: the one that explains best
    the last third of the recordings, fitted to the rest.
    """

    kind: Literal["none", "euclidean", "entropic"] = "none"
    weight: NonNegative | Literal["held_out"] = "held_out"


class Identification(ExtendedSection):
    """Settings that turn a recording into equations, and equations into an estimate.

    `method` is the estimator, by default the one of `wls` and `huber` that predicts held-out parts of the recordings
    better; `edge` [s] is left out at both ends of every recording, two periods of the cut-off by default; `block` [s]
    is the block length of the uncertainty estimate; `delay` [s] is the delay of torque stamps against position stamps,
    by default none, or one of a few samples where that predicts held-out parts clearly better; `period` [s] averages a
    periodic motion over its periods, without the filters of the torque. `torque` is what drives measured or what they
    were told; left out, what they measured where a recording has it in every sample. `torque_factors` are what the
    recorded torque of each motor is multiplied by, in the order of the transmission: of recordings that were made with
    torque constants which have turned out to be wrong.
    """

    method: Method | Literal["choose"] = "choose"
    smoothing: Smoothing = Smoothing()
    reversal: Reversal = Reversal()
    friction: FrictionShape = FrictionShape()
    prior: PriorRegularisation = PriorRegularisation()
    edge: NonNegative | Literal["choose"] = "choose"
    block: Positive = 1.0
    delay: Number | Literal["estimate", "choose"] = "choose"
    period: Positive | None = None
    torque: Literal["measured", "commanded"] | None = None
    torque_factors: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = None
    later = frozenset({"torque", "torque_factors"})

    @model_validator(mode="after")
    def _averaged_instead(self) -> Identification:
        if self.period is None:
            return self
        smoothing = self.smoothing
        # True equals 1, so each is held against its own way of saying no.
        filters = {
            "decimate": smoothing.decimate != 1,
            "filter_torque": smoothing.filter_torque,
            "regressor_cutoff": smoothing.regressor_cutoff is not None,
        }
        if used := [key for key, is_on in filters.items() if is_on and key in smoothing.model_fields_set]:
            raise ValueError(f"period averages instead of filtering; leave out smoothing.{', smoothing.'.join(used)}")
        return self


class FourierJoint(Section):
    """Coefficients of one joint (table 5): a, b [rad/s], q0 [rad]."""

    a: Annotated[tuple[Number, ...], Field(min_length=1)]
    b: Annotated[tuple[Number, ...], Field(min_length=1)]
    q0: Number

    @model_validator(mode="after")
    def _same_length(self) -> FourierJoint:
        if len(self.a) != len(self.b):
            raise ValueError(f"{len(self.a)} sine but {len(self.b)} cosine coefficients")
        return self


class FourierMotion(Section):
    """Finite Fourier series (eq. 78) with `base_frequency` [Hz] that fades in and out over `ramp` [s]."""

    kind: Literal["fourier"]
    base_frequency: Positive
    periods: Count = 3
    ramp: NonNegative = 0.0
    joints: dict[str, FourierJoint]

    @model_validator(mode="after")
    def _same_harmonics(self) -> FourierMotion:
        if len({len(joint.a) for joint in self.joints.values()}) > 1:
            raise ValueError("the joints have different numbers of harmonics")
        return self


class SeededMotion(ExtendedSection):
    """Random Fourier motion, the same for the same seed, scaled into the arm's limits with a margin.

    It is about the middle of the position limits, or about home. About home the torque, of which gravity takes its part
    whatever `use` is, may take 70 % of its limit.
    """

    kind: Literal["seeded"]
    seed: Seed
    base_frequency: Positive = 0.05
    harmonics: Annotated[Count, Field(le=50)] = 5
    periods: Count = 3
    ramp: NonNegative = 0.0
    use: Annotated[float, Field(gt=0, le=1)] = 0.7
    about: Literal["middle", "home"] = "middle"
    later = frozenset({"about"})


Motion = Annotated[FourierMotion | SeededMotion, Field(discriminator="kind")]


class Motions(Section):
    """The motion to identify from and the one to validate on."""

    identification: Motion = SeededMotion(kind="seeded", seed=1)
    validation: Motion = SeededMotion(kind="seeded", seed=2)


_MOTION_DEPENDS_ON = (
    "kinematics",
    "gravity",
    "terms",
    "joints",
    "prior",
    "payload",
    "control",
    "transmission",
    "geometry",
    "workspace",
    "supply",
)


class ArmConfig(ExtendedSection):
    """A whole arm as its YAML file describes it; the first thing that passes every door.

    WARNING: with `unattended_motion: allowed` a scheduled re-identification, or one after maintenance, moves the arm
    with nobody there, at any hour and without any further word; preflight's question whether the arm is supported and
    nobody is within its reach is answered by this key alone. It is for the simulator, and for a cell whose fence and
    interlock take the drives' power away as soon as a person can reach in; software does not see people.

    `prior`, `driver.truth` and the bounds of `joints.*.body` and `constraints.total_mass` are of the arm alone;
    `payload` comes on top of them for as long as it is mounted.
    """

    later = frozenset({"payload", "realtime"})

    format: Literal["ident-arm"]
    version: Literal[1]
    # As long as an address of the API, and a folder with a time before it, may be.
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
    description: str = ""
    kinematics: Kinematics
    gravity: Vector3 = (0.0, 0.0, -9.81)
    terms: tuple[JointTerm, ...] = ("drive_inertia", "viscous", "coulomb", "offset")
    joints: dict[str, Joint] = Field(default_factory=dict)
    constraints: Constraints = Constraints()
    prior: ParameterTable | None = None
    payload: Payload | None = None
    feasible_set: FeasibleSetName = "pseudo_inertia"
    control: Control = Control()
    realtime: Realtime = Realtime()
    identification: Identification = Identification()
    recording: RecordingFormat = RecordingFormat()
    transmission: Transmission | None = None
    geometry: Geometry = Field(default_factory=dict)
    workspace: Workspace = Workspace()
    supply: Supply | None = None
    design: Design = Design()
    motions: Motions = Motions()
    driver: Driver | None = None
    unattended_motion: Literal["refused", "allowed"] = "refused"

    @property
    def can_buses(self) -> tuple[CanBus, ...]:
        """Return the CAN buses of the arm's drives, in the order of their numbers; none where they are on none."""
        if isinstance(self.driver, CanopenDriver):
            return self.driver.buses
        return (self.driver.bus,) if isinstance(self.driver, BarrettDriver) else ()

    @property
    def motor_torques(self) -> tuple[float, ...] | None:
        """Return what the motors give at most [N m], in the order of the transmission; None where unknown."""
        if isinstance(self.driver, CanopenDriver):
            return tuple(drive.max_torque * drive.torque_scale for drive in self.driver.drives)
        if isinstance(self.driver, BarrettDriver):
            return tuple(puck.max_torque * puck.torque_scale for puck in self.driver.pucks)
        return None

    @property
    def watchdog(self) -> float | None:
        """Return after how long without its host the slowest drive gives up torque [s]; None where unknown.

        What an open arm says of itself counts more (`ArmDescription.watchdog`); this is for before it is opened.
        """
        return self.driver.watchdog if isinstance(self.driver, _BUILT_IN) else None

    @property
    def watchdog_reason(self) -> str:
        """Return why drives of an arm that can fall may go on for longer than usual; empty for no reason."""
        return self.driver.watchdog_reason if isinstance(self.driver, _BUILT_IN) else ""

    @property
    def delay_cycles(self) -> int:
        """Return the cycles from a sample to the torque that is computed from it; 1 is the Arm contract's."""
        return self.driver.delay_cycles if isinstance(self.driver, SimulatedDriver) else 1

    @property
    def zeroed_at_home(self) -> bool:
        """Return whether a person zeroes the arm at its home, since encoders count from where power came."""
        at_home = isinstance(self.driver, CanopenDriver) and self.driver.zero == "at_home"
        return at_home or isinstance(self.driver, BarrettDriver)

    @property
    def idle_drives_hold(self) -> bool:
        """Return whether drives that were stopped go on holding the arm, as CANopen's in quick stop do.

        Idle pucks brake by their windings, so that an arm sinks; there is nothing to let go of.
        """
        return isinstance(self.driver, CanopenDriver)

    def has_brake(self, joint: str) -> bool:
        """Return whether a holding brake holds the joint when its drive has no power."""
        said = self.joints[joint].brake if joint in self.joints else None
        return said if said is not None else self.driver is not None and self.driver.kind == "simulated"

    @property
    def sha256(self) -> str:
        """Return the SHA-256 of the whole resolved description, files it names included."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    @property
    def motion_sha256(self) -> str:
        """Return the SHA-256 of all that the safety of a motion depends on: mechanism, limits, model, surroundings.

        Other estimators, recording formats, motions or drivers leave it as it is.
        """
        return hashlib.sha256(self.model_dump_json(include=set(_MOTION_DEPENDS_ON)).encode()).hexdigest()
