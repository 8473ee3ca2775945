"""Read from an arm's description what pages say of it: real or simulated, joints with units and limits, pictures.

What is computed from a description is kept by the file and its time of change, so that a list of arms reads each once.
Modules that compute with mechanisms are imported only where they are needed, so that the service starts without them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Literal

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.simulation import SimulatedDriver
from ident_service.daemon.dependencies import Service
from ident_service.errors import IdentError
from ident_service.registry.arms import description_path, known_arm
from ident_service.registry.database import Row
from ident_service.registry.motions import motion_path

Kind = Literal["simulated", "real", "recordings", "unreadable"]
WORDS: Final[dict[Kind, str]] = {
    "simulated": "simulated",
    "real": "real",
    "recordings": "recordings only",
    "unreadable": "description cannot be read",
}


@dataclass(frozen=True)
class ArmFacts:
    """Facts of an arm's description.

    Attributes:
        kind: `recordings` for an arm without a driver, which cannot be moved from here.
        driver: kind of the driver of a real arm; empty for others.
        joints: number of joints; 0 where the description does not list them.
        description: the description's own words.
    """

    kind: Kind
    driver: str
    joints: int
    description: str = ""

    @property
    def words(self) -> str:
        """Return the kind of the arm in words, for a real one with its driver."""
        return f"real, {self.driver}" if self.driver else WORDS[self.kind]


@dataclass(frozen=True)
class JointFacts:
    """Joint with its unit and limits, for plots and tables; None for what the description does not limit.

    Attributes:
        name: of the joint.
        unit: of its position, `rad` or `m`; its torque is in N m or N.
        lower: lowest position.
        upper: highest position.
        velocity: largest speed.
        torque: largest torque.
        error: largest following error.
    """

    name: str
    unit: Literal["rad", "m"]
    lower: float | None
    upper: float | None
    velocity: float | None
    torque: float | None
    error: float | None


def arm_facts(state: Path, row: Row) -> ArmFacts:
    """Return kind, driver and number of joints of an arm; `unreadable` as kind where its file cannot be read."""
    try:
        path = description_path(state, row)
        return _facts(path, path.stat().st_mtime_ns)
    except (IdentError, OSError):
        return ArmFacts("unreadable", "", 0)


@lru_cache(maxsize=512)
def _facts(path: Path, changed: int) -> ArmFacts:
    del changed  # part of the key
    return facts_of(load_arm(path))


def facts_of(config: ArmConfig) -> ArmFacts:
    """Return kind (`recordings`, `simulated`, `real`), driver, number of joints and text of a description."""
    driver = config.driver
    if driver is None:
        return ArmFacts("recordings", "", len(config.joints), config.description)
    if isinstance(driver, SimulatedDriver):
        return ArmFacts("simulated", "", len(config.joints), config.description)
    return ArmFacts("real", str(driver.kind), len(config.joints), config.description)


def joint_facts(config: ArmConfig) -> list[dict[str, Any]]:
    """Return the joints of a description (`JointFacts`) as JSON values; none where it has no readable mechanism."""
    try:
        names, revolute = _joints(config)
    except IdentError:
        return []
    found = []
    for name, turns in zip(names, revolute, strict=True):
        joint = config.joints.get(name)
        lower, upper = (None, None) if joint is None or joint.position is None else joint.position
        rest = (None,) * 3 if joint is None else (joint.velocity, joint.torque, joint.following_error)
        found.append(asdict(JointFacts(name, "rad" if turns else "m", lower, upper, *rest)))
    return found


def _joints(config: ArmConfig) -> tuple[tuple[str, ...], tuple[bool, ...]]:
    """Return the joints' names and whether they turn; the daemon loads no parser of pinocchio for them."""
    from ident_service.model.chain import chain_from_dh
    from ident_service.model.mechanism import read_mechanism, require_parser_limits
    from ident_service.model.xml_elements import parse_xml

    kinematics = config.kinematics
    if kinematics.dh is not None:
        chain = chain_from_dh(kinematics.dh, config.gravity)
        return chain.names, chain.revolute
    if kinematics.urdf is not None:
        require_parser_limits(kinematics.urdf, "urdf")
        kinds = {joint.get("name"): joint.get("type") for joint in parse_xml(kinematics.urdf.text).iter("joint")}
        return tuple(config.joints), tuple(kinds.get(name) != "prismatic" for name in config.joints)
    if kinematics.mjcf is not None:
        found = read_mechanism(kinematics.mjcf, "mjcf", kinematics)
        return found.names, found.revolute
    return (), ()


def home_svg(service: Service, arm: str) -> str:
    """Return the picture of an arm at home, as an SVG."""
    found = known_arm(service.db, service.state, arm)
    return _home_svg(found.path, found.path.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _home_svg(path: Path, changed: int) -> str:
    from ident_service.model.arm_model import arm_model
    from ident_service.operations.arm_pictures import home_picture

    del changed
    return home_picture(arm_model(load_arm(path)))


def motion_svg(service: Service, arm: str, motion: str) -> str:
    """Return an SVG of an arm along the motion of this id; if empty, along its description's identification motion."""
    from ident_service.operations.arm_pictures import motion_picture

    return motion_picture(*_motion(service, arm, motion))


def extent(service: Service, arm: str, motion: str, speed: float) -> Any:
    """Return how far, fast and long an arm goes along a motion (`MotionExtent`); None where that cannot be computed."""
    from ident_service.operations.arm_pictures import motion_extent

    try:
        model, planned = _motion(service, arm, motion)
        return motion_extent(model, planned, speed)
    except IdentError:
        return None  # preflight says why


def _motion(service: Service, arm: str, motion: str) -> Any:
    from ident_service.excitation.described_motion import excitation
    from ident_service.excitation.motion_file import read_excitation
    from ident_service.model.arm_model import arm_model

    model = arm_model(known_arm(service.db, service.state, arm).config)
    if motion:
        return model, read_excitation(motion_path(service.db, service.state, motion))
    return model, excitation(model, "identification", checked=False)
