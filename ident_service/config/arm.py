"""Describe an arm: mechanism, limits, gains, physical knowledge, driver, as checked configuration.

`yaml_source.py` and `load.py` read the YAML. SI units; angles in radians. Tables 2, 4, 5 and 7 and eqs. 25, 26, 28 of
Sousa & Cortesao 2014 have their place here.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeGuard

from pydantic import (
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Tag,
    TypeAdapter,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import core_schema

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

if TYPE_CHECKING:
    from ident_service.config.barrett import BarrettDriver
    from ident_service.config.can_bus import CanBus
    from ident_service.config.canopen import CanopenDriver

BUILT_IN_KINDS = ("simulated", "canopen", "barrett")
_LARGEST_GRAVITY = 30.0  # m/s^2; Jupiter has 25


class PluginDriver(Section):
    """Driver that another distribution provides; it checks its own options."""

    model_config = ConfigDict(frozen=True, extra="allow")

    # Built-in kinds are described by their own sections.
    kind: Annotated[str, Field(json_schema_extra={"not": {"enum": list(BUILT_IN_KINDS)}})]
    """Name under which another distribution registers its driver; the keys beside it are that driver's."""


def _driver_kind(value: Any) -> str:
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return kind if kind in BUILT_IN_KINDS else "plugin"


def _driver_model(kind: str) -> type[Section]:
    """Return the model of a kind of driver; those of real drives are loaded with the first arm that has them."""
    if kind == "canopen":
        from ident_service.config.canopen import CanopenDriver

        return CanopenDriver
    if kind == "barrett":
        from ident_service.config.barrett import BarrettDriver

        return BarrettDriver
    return SimulatedDriver if kind == "simulated" else PluginDriver


def _driver_section(value: Any, info: ValidationInfo) -> Section:
    # Chosen by `kind`, so that a mistake in a built-in driver's section is not taken for a plug-in's options.
    return _driver_model(_driver_kind(value)).model_validate(value, context=info.context)


class _OfItsKind:
    """Marks the section `driver` as one of several models, none of which is loaded before an arm has it."""

    def __get_pydantic_core_schema__(self, _source: Any, _handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        as_it_is = core_schema.simple_ser_schema("any")
        return core_schema.with_info_plain_validator_function(_driver_section, serialization=as_it_is)

    def __get_pydantic_json_schema__(
        self, _schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        kinds = [Annotated[_driver_model(kind), Tag(kind)] for kind in (*BUILT_IN_KINDS, "plugin")]
        union: Any = Annotated[kinds[0] | kinds[1] | kinds[2] | kinds[3], Discriminator(_driver_kind)]
        return handler(TypeAdapter(union).core_schema)


if TYPE_CHECKING:
    Driver = SimulatedDriver | CanopenDriver | BarrettDriver | PluginDriver
else:
    Driver = Annotated[Section, _OfItsKind()]


def is_canopen(driver: Driver | None) -> TypeGuard[CanopenDriver]:
    """Return whether the driver's `kind` is `canopen`; False for None. Loads no CANopen module."""
    return driver is not None and driver.kind == "canopen"


def is_barrett(driver: Driver | None) -> TypeGuard[BarrettDriver]:
    """Return whether the driver's `kind` is `barrett` (pucks of a WAM); False for None."""
    return driver is not None and driver.kind == "barrett"


JointTerm = Literal["drive_inertia", "viscous", "coulomb", "offset", "stribeck", "quadratic", "viscous_asymmetry"]
FeasibleSetName = Literal["pseudo_inertia", "inertia"]
Method = Literal["ols", "wls", "huber", "iv"]


_FUNCTION = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*$"


class Box(Section):
    """An axis-aligned box in a link frame [m] (table 7)."""

    lower: Vector3
    """Lowest corner [m]."""
    upper: Vector3
    """Highest corner [m]."""

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        for axis, lower, upper in zip("xyz", self.lower, self.upper, strict=True):
            if not lower < upper:
                raise ValueError(
                    f"{axis}: lower bound {lower:g} is not below upper bound {upper:g}; check order and units"
                )
        return self


class Ellipsoid(Section):
    """Ellipsoid in a link frame that contains all mass of the link."""

    center: Vector3
    """Centre in the link's frame [m]."""
    semi_axes: tuple[Positive, Positive, Positive]
    """Half-axes [m]."""
    axes: tuple[Vector3, Vector3, Vector3] | None = None
    """Unit vectors along the half-axes [1]; those of the link's frame when left out."""

    @model_validator(mode="after")
    def _orthonormal(self) -> Ellipsoid:
        for i, one in enumerate(self.axes or ()):
            for j, other in enumerate(self.axes or ()):
                if abs(sum(a * b for a, b in zip(one, other, strict=True)) - float(i == j)) > 1e-6:
                    raise ValueError("axes are not three perpendicular unit vectors")
        return self


class Body(Section):
    """Prior knowledge about the link that a joint moves (eqs. 25, 26)."""

    mass: Interval | None = None
    """Lowest and highest mass of the link [kg] (eq. 25)."""
    center_of_mass: Box | None = None
    """Box that the centre of mass lies in (eq. 26)."""
    hull: Annotated[tuple[Vector3, ...], Field(min_length=4)] | None = None
    """Points whose convex hull contains the centre of mass [m], at least four."""
    ellipsoid: Ellipsoid | None = None
    """Ellipsoid that contains all mass of the link."""
    symmetry: tuple[Literal["xy", "yz", "xz"], ...] = ()
    """Coordinate planes of the link's frame that its mass is symmetric about."""


class Joint(ExtendedSection):
    """Limits, gains and body of one joint; what a motion needs may be left out of an arm that is only identified."""

    position: Interval | None = None
    """Lowest and highest position [rad or m]; angles may be written `-pi/2` or `'90 deg'`."""
    velocity: Positive | None = None
    """Largest speed [rad/s or m/s]."""
    acceleration: Positive | None = None
    """Largest acceleration [rad/s^2 or m/s^2]."""
    jerk: Positive | None = None
    """Largest jerk [rad/s^3 or m/s^3]."""
    torque: Positive | None = None
    """Largest torque or force at the joint [N m or N]."""
    following_error: Positive | None = None
    """Distance from the reference at which a motion is stopped [rad or m]."""
    home: Angle | None = None
    """Posture in which motions begin and end [rad or m]; zero, or the limit nearest to it, when left out."""
    kp: Positive | None = None
    """Position gain: acceleration per position error [1/s^2] (table 4)."""
    kd: Positive | None = None
    """Velocity gain: acceleration per speed error [1/s] (table 4)."""
    drive_inertia: NonNegative | None = None
    """Inertia of the joint's rotors at the joint by data sheet, the least that is there [kg m^2 or kg]. Margins of the
    gains are stated with it where the prior, a CAD model of the links, lacks it."""
    brake: bool | None = None
    """A holding brake closes whenever the power stage is off. Where nothing is said, a simulated drive has one and a
    real one has none."""
    later = frozenset({"brake"})
    body: Body = Body()
    """Knowledge about the link that the joint moves."""

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
    """Lowest mass [kg]."""
    upper: Positive | None = None
    """Highest mass [kg]; no bound when left out."""


class Constraints(ExtendedSection):
    """Physical knowledge about the whole arm (eqs. 25, 28)."""

    total_mass: Mass = Mass()
    """Bounds of the mass of all moving links together."""
    positive: tuple[Literal["drive_inertia", "viscous", "coulomb"], ...] = ("drive_inertia", "viscous", "coulomb")
    """Parameters of the joints that are not negative."""
    torque_constant: dict[str, tuple[Positive, Positive]] = Field(default_factory=dict)
    """By joint, bounds of the factor that makes its measured torque true [1]; 1 for joints that are not named."""
    custom: Annotated[str, Field(pattern=_FUNCTION)] | None = None
    """Python function, `module:function`, that returns further constraints in cvxpy (docs/extending.md). The module
    stands beside the description or on PYTHONPATH; a description that is sent to a daemon must not name one."""
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
    """Zero-phase low-pass and derivatives (5.2.2)."""

    method: Literal["butterworth", "savitzky_golay"] = "butterworth"
    """`butterworth` of `order`, or `savitzky_golay` polynomials of that degree over a window of about the same cut-off.
    """
    order: Annotated[Count, Field(le=8)] = 3
    """Order of the low-pass, or degree of the polynomials [1]."""
    cutoff: Positive | Literal["choose"] = "choose"
    """Cut-off frequency [Hz]; `choose`: from the spectra of the positions."""
    filter_torque: bool = True
    """The torque goes through the Butterworth filter, too."""
    regressor_cutoff: Positive | None = None
    """Cut-off of a filter for both sides of eq. 59 alike [Hz]; the torque is then filtered no second time."""
    decimate: Count | Literal["choose"] = "choose"
    """Every so many-th sample is kept after all filters [1]; `choose`: ten in a period of the cut-off."""
    velocity: Literal["position", "measured", "choose"] = "choose"
    """The recording's own velocity, or that of the positions; `choose`: the recording's where it has one that predicts
    better."""

    @model_validator(mode="before")
    @classmethod
    def _filtered_once(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("regressor_cutoff") is not None:
            return {"filter_torque": False} | data
        return data


class Reversal(Section):
    """Rows of a joint near standstill.

    Their friction is known less well than that of a joint in motion, and they count as their residuals allow.
    """

    speed: NonNegative = 0.05
    """Speed below which a joint counts as standing [rad/s or m/s]."""
    window: NonNegative = 0.2
    """Time before and after a reversal that counts likewise [s]."""


class FrictionShape(Section):
    """Nonlinear friction parameters, per joint or one number for all, given or fitted."""

    presliding: NonNegative | tuple[NonNegative, ...] | Literal["fit"] = "fit"
    """Distance over which friction turns round with the velocity (Dahl 1968) [rad or m], one or per joint; 0 for at
    once, `fit` for fitted."""
    stribeck_velocity: Positive | tuple[Positive, ...] | Literal["fit"] = "fit"
    """v_s of the term `stribeck` [rad/s or m/s], one or per joint; `fit` for fitted."""


class PriorRegularisation(Section):
    """Regularisation of constrained estimates towards the prior (CAD) parameters: divergence and weight."""

    kind: Literal["none", "euclidean", "entropic"] = "none"
    """Divergence from the prior that is penalised."""
    weight: NonNegative | Literal["held_out"] = "held_out"
    """Weight of one unit of divergence against one residual variance [1]; `held_out`: the one that explains best the
    last third of the recordings, fitted to the rest."""


class Identification(ExtendedSection):
    """Settings that turn a recording into equations, and equations into an estimate."""

    method: Method | Literal["choose"] = "choose"
    """Estimator: ordinary, weighted or robust least squares, or instrumental variables; `choose`: the one of `wls` and
    `huber` that predicts held-out parts of the recordings better."""
    smoothing: Smoothing = Smoothing()
    """Low-pass and derivatives."""
    reversal: Reversal = Reversal()
    """Weight of rows near a standstill."""
    friction: FrictionShape = FrictionShape()
    """Nonlinear friction parameters."""
    prior: PriorRegularisation = PriorRegularisation()
    """Regularisation towards the prior."""
    edge: NonNegative | Literal["choose"] = "choose"
    """Time that is left out at both ends of every recording [s]; `choose`: two periods of the cut-off."""
    block: Positive = 1.0
    """Block length of the uncertainty estimate [s]."""
    delay: Number | Literal["estimate", "choose"] = "choose"
    """Delay of torque stamps against position stamps [s]; `estimate`: estimated; `choose`: none, or one of a few
    samples where that predicts held-out parts clearly better."""
    period: Positive | None = None
    """Period over which a periodic motion is averaged [s], instead of filters of the torque; no averaging when left
    out."""
    torque: Literal["measured", "commanded"] | None = None
    """Torque that drives measured, or were told; left out, what they measured where a recording has it in every sample.
    """
    torque_factors: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = None
    """Factors that recorded torques of the motors are multiplied by [1], one a motor in the order of the transmission:
    for recordings that were made with torque constants which have turned out to be wrong; all 1 when left out."""
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
    """Coefficients of one joint (table 5)."""

    a: Annotated[tuple[Number, ...], Field(min_length=1)]
    """Sine coefficients [rad/s or m/s]."""
    b: Annotated[tuple[Number, ...], Field(min_length=1)]
    """Cosine coefficients [rad/s or m/s]."""
    q0: Number
    """Middle of the motion [rad or m]."""

    @model_validator(mode="after")
    def _same_length(self) -> FourierJoint:
        if len(self.a) != len(self.b):
            raise ValueError(f"{len(self.a)} sine but {len(self.b)} cosine coefficients")
        return self


class FourierMotion(Section):
    """Finite Fourier series (eq. 78) that fades in and out."""

    kind: Literal["fourier"]
    """Fourier series with given coefficients."""
    base_frequency: Positive
    """Frequency of the first harmonic [Hz]."""
    periods: Count = 3
    """Number of periods [1]."""
    ramp: NonNegative = 0.0
    """Time to swell from rest, and to die down [s]."""
    joints: dict[str, FourierJoint]
    """Coefficients of every joint, in the order of the arm."""

    @model_validator(mode="after")
    def _same_harmonics(self) -> FourierMotion:
        if len({len(joint.a) for joint in self.joints.values()}) > 1:
            raise ValueError("the joints have different numbers of harmonics")
        return self


class SeededMotion(ExtendedSection):
    """Random Fourier motion, the same for the same seed, scaled into the arm's limits with a margin."""

    kind: Literal["seeded"]
    """Random Fourier motion, the same for the same seed."""
    seed: Seed
    """Seed of the random numbers [1]."""
    base_frequency: Positive = 0.05
    """Frequency of the first harmonic [Hz]."""
    harmonics: Annotated[Count, Field(le=50)] = 5
    """Number of harmonics [1]."""
    periods: Count = 3
    """Number of periods [1]."""
    ramp: NonNegative = 0.0
    """Time to swell from rest, and to die down [s]."""
    use: Annotated[float, Field(gt=0, le=1)] = 0.7
    """Share of the limits that the motion uses [1]."""
    about: Literal["middle", "home"] = "middle"
    """Centre of the motion: the middle of the position limits, or home. About home the torque, of which gravity takes
    its part whatever `use` is, may take 70 % of its limit."""
    later = frozenset({"about"})


Motion = Annotated[FourierMotion | SeededMotion, Field(discriminator="kind")]


class Motions(Section):
    """The motion to identify from and the one to validate on."""

    identification: Motion = SeededMotion(kind="seeded", seed=1)
    """Motion to identify from."""
    validation: Motion = SeededMotion(kind="seeded", seed=2)
    """Motion to validate on."""


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
    """A whole arm as its YAML file describes it.

    WARNING: with `unattended_motion: allowed` a scheduled re-identification, or one after maintenance, moves the arm
    with nobody there, at any hour and without any further word; preflight's question whether the arm is supported and
    nobody is within its reach is answered by this key alone. It is for the simulator, and for a cell whose fence and
    interlock take the drives' power away as soon as a person can reach in; software does not see people.

    `prior`, `driver.truth` and the bounds of `joints.*.body` and `constraints.total_mass` are of the arm alone;
    `payload` comes on top of them for as long as it is mounted.
    """

    later = frozenset({"payload", "realtime"})

    format: Literal["ident-arm"]
    """Kind of file."""
    version: Literal[1]
    """Version of the format."""
    # As long as an address of the API, and a folder with a time before it, may be.
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
    """Name of the arm: letters, digits and `_.-`, at most 64; registry, folders and files use it."""
    description: str = ""
    """Words for people."""
    kinematics: Kinematics
    """Mechanism: a DH table, or the part of a URDF or MJCF file that is the arm."""
    gravity: Vector3 = (0.0, 0.0, -9.81)
    """Gravity in the frame of the base [m/s^2]."""
    terms: tuple[JointTerm, ...] = ("drive_inertia", "viscous", "coulomb", "offset")
    """Parameters of every joint beside its link's."""
    joints: dict[str, Joint] = Field(default_factory=dict)
    """Limits, gains and knowledge by joint name, in the order of the mechanism."""
    constraints: Constraints = Constraints()
    """Physical knowledge about the whole arm."""
    prior: ParameterTable | None = None
    """Known link parameters of the arm alone, such as those of CAD [SI]: `{m1: 2.0, ...}`, or a JSON file with `names`
    and `values`. Those of a URDF or MJCF when left out."""
    payload: Payload | None = None
    """Tool or load that is mounted."""
    feasible_set: FeasibleSetName = "pseudo_inertia"
    """Bodies that identified links may be: with a density that is nowhere negative (`pseudo_inertia`), or with a
    positive mass and inertia (`inertia`), which is weaker."""
    control: Control = Control()
    """Control loop, and what follows a stop."""
    realtime: Realtime = Realtime()
    """Scheduling of the motion process on this computer."""
    identification: Identification = Identification()
    """Settings of the estimate."""
    recording: RecordingFormat = RecordingFormat()
    """Format of recordings."""
    transmission: Transmission | None = None
    """Gears and couplings between motors and joints."""
    geometry: Geometry = Field(default_factory=dict)
    """Capsules of links, by joint name or `base`, in the links' frames; they replace the geometry of a URDF. An empty
    list is a link without any."""
    workspace: Workspace = Workspace()
    """Obstacles and allowed space."""
    supply: Supply | None = None
    """Power supply of the drives."""
    design: Design = Design()
    """Settings for `ident design`."""
    motions: Motions = Motions()
    """Motions that are made without a motion file."""
    driver: Driver | None = None
    """Access to the arm: `simulated`, `canopen`, `barrett`, or the name of another distribution's driver. Left out for
    an arm that is identified from recordings only."""
    unattended_motion: Literal["refused", "allowed"] = "refused"
    """Permission for a scheduled re-identification to move the arm with nobody there. `allowed` is for the simulator,
    and for a cell whose fence and interlock take the drives' power away as soon as a person can reach in."""

    @field_validator("gravity")
    @classmethod
    def _of_a_planet(cls, value: Vector3) -> Vector3:
        if (size := sum(part * part for part in value) ** 0.5) > _LARGEST_GRAVITY:
            raise ValueError(f"{size:g} m/s^2 is more than any planet has; in mm/s^2? gravity is [0, 0, -9.81]")
        return value

    @property
    def can_buses(self) -> tuple[CanBus, ...]:
        """Return the CAN buses of CANopen or Barrett drives, in the order of their numbers; empty for others."""
        if is_canopen(self.driver):
            return self.driver.buses
        return (self.driver.bus,) if is_barrett(self.driver) else ()

    @property
    def motor_torques(self) -> tuple[float, ...] | None:
        """Return the largest torque of each motor [N m], in the order of the transmission; None without CAN drives."""
        if is_canopen(self.driver):
            return tuple(drive.max_torque * drive.torque_scale for drive in self.driver.drives)
        if is_barrett(self.driver):
            return tuple(puck.max_torque * puck.torque_scale for puck in self.driver.pucks)
        return None

    @property
    def point_speed_limit(self) -> float | None:
        """Return the speed of elbow and tip at which the arm's own safety system stops it [m/s]; None without one."""
        return self.driver.limits.velocity if is_barrett(self.driver) else None

    @property
    def watchdog(self) -> float | None:
        """Return how long the slowest drive keeps torque without its host [s]; None without driver or for a plugin.

        What an open arm reports of itself counts more (`ArmDescription.watchdog`); this is for before it is opened.
        """
        return None if self.driver is None or isinstance(self.driver, PluginDriver) else self.driver.watchdog

    @property
    def watchdog_reason(self) -> str:
        """Return the stated reason why drives may keep torque without host unusually long; empty where none is."""
        return "" if self.driver is None or isinstance(self.driver, PluginDriver) else self.driver.watchdog_reason

    @property
    def delay_cycles(self) -> int:
        """Return the cycles from a sample to its torque's effect: the simulated driver's setting, 1 for all others."""
        return self.driver.delay_cycles if isinstance(self.driver, SimulatedDriver) else 1

    @property
    def zeroed_at_home(self) -> bool:
        """Return whether encoders count from power-on, so a person zeroes at home: Barrett, or `zero: at_home`."""
        at_home = is_canopen(self.driver) and self.driver.zero == "at_home"
        return at_home or is_barrett(self.driver)

    @property
    def idle_drives_hold(self) -> bool:
        """Return whether drives go on holding the arm after a stop: True for CANopen drives (quick stop), else False.

        Idle pucks brake by their windings, so that an arm sinks; there is nothing to let go of.
        """
        return is_canopen(self.driver)

    def has_brake(self, joint: str) -> bool:
        """Return the joint's `brake` (holding without power) as described; if unsaid, True for a simulated arm only."""
        said = self.joints[joint].brake if joint in self.joints else None
        return said if said is not None else self.driver is not None and self.driver.kind == "simulated"

    @property
    def sha256(self) -> str:
        """Return the SHA-256 (hex) of the whole resolved description, files it names included."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    @property
    def motion_sha256(self) -> str:
        """Return the SHA-256 of mechanism, limits, prior, payload, control, surroundings and supply, not the driver.

        Other estimators, recording formats, motions or drivers leave it as it is.
        """
        return hashlib.sha256(self.model_dump_json(include=set(_MOTION_DEPENDS_ON)).encode()).hexdigest()
