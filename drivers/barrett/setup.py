"""Read and write the properties of pucks before anything streams: wake them, check them, limit them, zero the arm.

Order (libbarrett, OWD, btclient): STAT of everybody; those in their monitor are woken one at a time, 10 ms apart, as a
transceiver that starts can disturb the bus; a second later everybody must be ready. Then VERS and ROLE, from which the
numbers of all other properties follow; group frames need the same numbers for P and T in all motor pucks. Then what
each reports of itself is compared with the description (`checks`).

A puck counts from where it was when power came. Its positions are the arm's once a person has led the arm home and has
said so (`ident set-home ARM`); the safety puck remembers that (ZERO = 1) for as long as it has power. A motor with
an absolute encoder and a calibrated `zero_angle` corrects what the person could not see, within half a turn:

    error = wrap(J home + zero_angle - 2 pi MECH/CTS),    P = CTS/(2 pi) (J home - error).

The safety puck sees positions jump when they are written, and would take that for speed: IFAULT tells it how many
velocity faults to ignore.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.arm import SetupCheck
from drivers.barrett.protocol import (
    ABSOLUTE_ENCODER,
    ABSOLUTE_SINCE,
    HOST,
    ROLE_MASK,
    Group,
    Mode,
    Position,
    Properties,
    Reply,
    Role,
    SafetyMode,
    Status,
    address_of,
    decoded,
    get_frame,
    set_frame,
)
from drivers.can.bus_state import ControllerState, controller_state
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.motor_units import Coordinates, Vector
from ident_service.config.barrett import VELOCITY_UNIT, WARNING, BarrettDriver, Puck
from ident_service.errors import DriverError, PositionUnknown

TIMEOUT: Final = 0.05  # s that a puck may take to answer
_TRIES: Final = 3
_WAKE: Final = 1.2  # s that a puck takes from its monitor to its firmware
_APART: Final = 0.01  # s between two messages that configure
_HUSH, _LISTEN = 0.02, 0.12  # s in which the last frames of an earlier session may come; in which another host shows
IGNORED_FAULTS: Final = 8  # velocity faults that the safety puck ignores while positions jump (IFAULT; OWD)
_GROUPS = ("GRPA", "GRPB", "GRPC")
_LIMITS = ("VL1", "VL2", "TL1", "TL2")
_READ = ("SN", *_GROUPS, "PIDX", "CTS", "MT", "IPNM", "POLES", "OTEMP")
_FIXED = Properties(0x7FFF, Role.MOTOR)  # for VERS, ROLE, STAT and MODE, whose numbers are the same everywhere
DEFAULT_IPNM: Final = 2700  # libbarrett's, of firmware that has none to tell


class PropertyPort:
    """Read and write single properties over an open link, while nothing streams.

    Attributes:
        controller: state of the host's CAN controller, as far as it was heard.
    """

    def __init__(self, link: Link) -> None:
        """Use an open link, which stays open."""
        self.link = link
        self.clock = link.clock
        self.controller = ControllerState.ACTIVE

    def ask(self, node: int, property_number: int) -> int | None:
        """Return the value of a property; None where no answer comes within a few tries.

        Args:
            node: of the puck.
            property_number: of the property.
        """
        for _ in range(_TRIES):
            self.link.send(get_frame(node, property_number))
            until_ns = self.clock.now_ns() + round(TIMEOUT * 1e9)
            while (frame := self._received(until_ns)) is not None:
                answer = decoded(frame)
                if isinstance(answer, Reply) and (answer.node, answer.number) == (node, property_number):
                    return answer.value
        return None

    def read(self, node: int, properties: Properties, property_name: str) -> int:
        """Return the value of a property; raises DriverError where no answer comes."""
        value = self.ask(node, properties.number(property_name))
        if value is None:
            raise DriverError(f"puck {node} does not answer for {property_name}; check power, cable and bit rate")
        return value

    def write(self, node: int, properties: Properties, property_name: str, value: int, *, verify: bool = True) -> None:
        """Set a property, wait a moment, and read it back if `verify`; DriverError where it holds another value.

        Raises:
            DriverError: it does not answer, or holds another value then.
        """
        self.link.send(set_frame(node, properties.number(property_name), value))
        self.pause(_APART)
        if verify and (found := self.read(node, properties, property_name)) != value:
            raise DriverError(f"puck {node}: {property_name} is {found} after {value} was written")

    def positions(self, properties: Properties, nodes: Iterable[int]) -> dict[int, int]:
        """Request all pucks' positions with one frame; return those of `nodes` that come in time [counts], by node."""
        self.link.send(get_frame(Group.ARM, properties.number("P"), group=True))
        wanted, found = set(nodes), dict[int, int]()
        until_ns = self.clock.now_ns() + round(TIMEOUT * 1e9)
        while wanted - set(found) and (frame := self._received(until_ns)) is not None:
            if isinstance(answer := decoded(frame), Position) and answer.node in wanted:
                found[answer.node] = answer.counts
        return found

    def pause(self, seconds: float) -> None:
        """Sleep for so many seconds of the link's clock."""
        self.clock.sleep_until_ns(self.clock.now_ns() + round(seconds * 1e9))

    def listen(self) -> None:
        """Listen whether another host talks to pucks; raises DriverError where one does. Nothing is sent."""
        self.pause(_HUSH)
        self._drained()
        self.pause(_LISTEN)
        others = [one for one in self._drained() if _of_a_host(one)]
        if others:
            raise DriverError(
                f"somebody else sends frames {others[0].identifier:03X}h on this bus: another program or device drives "
                "this arm"
            )

    def _received(self, until_ns: int) -> Frame | None:
        """Return the next frame, None when there is none until this time [ns]."""
        frame = self.link.receive(until_ns)
        self._hear(() if frame is None else (frame,))
        return frame

    def _drained(self) -> Sequence[Frame]:
        """Return all frames that have been received and not returned yet."""
        frames = self.link.drain()
        self._hear(frames)
        return frames

    def _hear(self, frames: Sequence[Frame]) -> None:
        for frame in frames:
            if frame.error:
                self.controller = controller_state(frame, self.controller)


def _of_a_host(frame: Frame) -> bool:
    return not (frame.error or frame.extended) and address_of(frame.identifier).sender == HOST


@dataclass(frozen=True)
class FoundPuck:
    """Hold what one motor puck reports of itself.

    Attributes:
        puck: section of the description for the puck.
        properties: properties of its firmware and role.
        role: ROLE with its option bits.
        values: values of the properties in `_READ` that its firmware has, by name.
    """

    puck: Puck
    properties: Properties
    role: int
    values: Mapping[str, int]

    @property
    def has_absolute_encoder(self) -> bool:
        """Return whether MECH is an absolute angle within a motor turn, by the puck's ROLE and firmware version."""
        return bool(self.role & ABSOLUTE_ENCODER) and self.properties.version >= ABSOLUTE_SINCE

    def __str__(self) -> str:
        said = " ".join(f"{name} {self.values[name]}" for name in ("SN", "IPNM", "MT", "CTS") if name in self.values)
        return f"puck {self.puck.node}: VERS {self.properties.version} ROLE {self.role:04X}h {said}"


@dataclass(frozen=True)
class FoundArm:
    """Hold what all pucks of an arm report of themselves.

    Attributes:
        pucks: the motor pucks, in the arm's order.
        safety: properties of the safety puck.
        safety_node: node of the safety puck.
        asleep: nodes in their monitor.
    """

    pucks: tuple[FoundPuck, ...]
    safety: Properties
    safety_node: int
    asleep: tuple[int, ...] = ()

    @property
    def motors(self) -> Properties:
        """Return the property numbers of the first motor puck, by which all motor pucks are asked at once."""
        return self.pucks[0].properties


def read_pucks(port: PropertyPort, driver: BarrettDriver, *, wakes: bool = True) -> FoundArm:
    """Read version, role and settings of an arm's pucks, waking those asleep, or PositionUnknown if not to wake any.

    Args:
        port: port to the bus.
        driver: the section `driver`.
        wakes: whether pucks in their monitor are woken; otherwise nothing is sent but questions.

    Raises:
        DriverError: pucks do not answer, are no motor or safety puck, or have numbers of their own for position or
            torque, so that one frame cannot reach all of them.
        PositionUnknown: some are asleep, and are not to be woken.
    """
    nodes = [*(puck.node for puck in driver.pucks), driver.safety_node]
    stat = _FIXED.number("STAT")
    states = {node: port.ask(node, stat) for node in nodes}
    if silent := [node for node, state in states.items() if state is None]:
        raise DriverError(
            f"no answer of pucks {', '.join(map(str, silent))}; check power, cable and bit rate, and driver.pucks"
        )
    asleep = [node for node, state in states.items() if state == Status.RESET]
    if asleep and not wakes:
        raise PositionUnknown(
            f"pucks {', '.join(map(str, asleep))} have just been switched on and are not awake: lead the arm home by "
            "hand, then `ident set-home ARM`, which wakes them"
        )
    for node in asleep:
        port.write(node, _FIXED, "STAT", Status.READY, verify=False)
    if asleep:
        port.pause(_WAKE)
        states = {node: port.ask(node, stat) for node in nodes}
        if still := [node for node in asleep if states[node] in (None, Status.RESET)]:
            raise DriverError(f"pucks {', '.join(map(str, still))} do not wake up; switch the arm off and on again")
    found = []
    for puck in driver.pucks:
        version, role = (port.read(puck.node, _FIXED, name) for name in ("VERS", "ROLE"))
        if role & ROLE_MASK != Role.MOTOR:
            raise DriverError(f"puck {puck.node} has ROLE {role:04X}h, which is no motor puck of a WAM")
        properties = Properties(version, role)
        values = {name: port.read(puck.node, properties, name) for name in _READ if name in properties}
        found.append(FoundPuck(puck, properties, role, values))
    version, role = (port.read(driver.safety_node, _FIXED, name) for name in ("VERS", "ROLE"))
    if role & ROLE_MASK != Role.SAFETY:
        raise DriverError(f"puck {driver.safety_node} has ROLE {role:04X}h, which is no safety puck")
    arm = FoundArm(tuple(found), Properties(version, role), driver.safety_node, tuple(asleep))
    for name in ("P", "T"):
        numbers = {one.puck.node: one.properties.number(name) for one in arm.pucks}
        if len(set(numbers.values())) > 1:
            versions = ", ".join(f"puck {one.puck.node} {one.properties.version}" for one in arm.pucks)
            raise DriverError(
                f"the property {name} has another number in some pucks, so one frame cannot reach all of them; install "
                f"the same firmware in all ({versions})"
            )
    return arm


def checks(arm: FoundArm) -> tuple[SetupCheck, ...]:
    """Return set-up checks of each puck's firmware, groups, slot and scales against the description."""
    versions = sorted({one.properties.version for one in arm.pucks})
    expected = str(versions[-1]) if len(versions) > 1 else ""
    found = []
    for one in arm.pucks:
        puck, node = one.puck, one.puck.node
        firmware = "Bring all pucks to one firmware; their properties differ otherwise."
        found.append(SetupCheck(f"VERS of puck {node}", str(one.properties.version), expected, firmware))
        groups = sorted(one.values[name] for name in _GROUPS)
        wanted = sorted((Group.ALL, puck.group, Group.ARM))
        found.append(
            SetupCheck(
                f"groups of puck {node}",
                _listed(groups),
                _listed(wanted),
                f"Set GRPA, GRPB and GRPC of puck {node} to {_listed(wanted)} with Barrett's btutil.",
            )
        )
        slot = "Set PIDX with Barrett's btutil; another puck would follow this one's torque."
        found.append(SetupCheck(f"PIDX of puck {node}", str(one.values["PIDX"]), str(puck.slot), slot))
        for name, told in (("CTS", puck.cts), ("MT", puck.mt), ("IPNM", puck.ipnm), ("POLES", puck.poles)):
            if told is None or (name not in one.values and name != "IPNM"):
                continue
            known = one.values.get(name, DEFAULT_IPNM)
            why = {
                "CTS": "Positions would be wrong by that factor: correct driver.pucks, or the puck.",
                "MT": "Find out which limit the arm was delivered with, then set driver.pucks, or the puck.",
                "IPNM": "Every torque would be wrong by that factor: enter the puck's own IPNM in driver.pucks.",
                "POLES": "The puck would commutate another motor: correct driver.pucks, or the puck.",
            }[name]
            found.append(SetupCheck(f"{name} of puck {node}", str(known), str(told), why))
    return tuple(found)


def nodes_without_group(arm: FoundArm) -> list[int]:
    """Return the nodes of pucks that lack the whole arm's group, or the group of their torque frame."""
    return [
        one.puck.node for one in arm.pucks if not {Group.ARM, one.puck.group} <= {one.values[name] for name in _GROUPS}
    ]


def _listed(numbers: Sequence[int]) -> str:
    return " ".join(str(int(number)) for number in numbers)


def write_safety_limits(port: PropertyPort, arm: FoundArm, driver: BarrettDriver) -> None:
    """Write velocity and torque limits, and warnings below them, to the safety puck, which keeps them until power off.

    Raises:
        DriverError: it does not answer, or holds other values then.
    """
    velocity, torque = driver.limits.velocity * VELOCITY_UNIT, driver.limits.torque
    values = (round(WARNING * velocity), round(velocity), round(WARNING * torque), torque)
    for name, value in zip(_LIMITS, values, strict=True):
        port.write(arm.safety_node, arm.safety, name, value)


def ignore_jumps(port: PropertyPort, arm: FoundArm) -> None:
    """Have the safety puck ignore some velocity faults (IFAULT), since positions jump when they are first asked for."""
    port.write(arm.safety_node, arm.safety, "IFAULT", IGNORED_FAULTS, verify=False)


def is_zeroed(port: PropertyPort, arm: FoundArm) -> bool:
    """Return whether the safety puck remembers that the arm has been zeroed since power came."""
    return port.read(arm.safety_node, arm.safety, "ZERO") == 1


def idle_frames(arm: FoundArm) -> tuple[Frame, Frame]:
    """Return the two frames that take all motor pucks and the safety puck to IDLE."""
    mode = _FIXED.number("MODE")
    return set_frame(Group.ALL, mode, Mode.IDLE, group=True), set_frame(arm.safety_node, mode, SafetyMode.IDLE)


_REST_SECONDS = 0.2
_REST_COUNTS = 8  # of a motor in that time: it stands, or its encoder is between two counts


def write_home(port: PropertyPort, arm: FoundArm, coordinates: Coordinates, home: Sequence[float]) -> tuple[str, ...]:
    """Write the home into the pucks as the position of the resting arm, and return in words what each got.

    Args:
        port: port to the bus.
        arm: the pucks' answers; the safety puck must not be ACTIVE.
        coordinates: coordinates of the arm, with counts of 0 where the transmission has its zero.
        home: home position of the joints [rad or m].

    Raises:
        DriverError: it is active, moves, or a puck does not keep its position. Then nobody counts it as zeroed.
    """
    if port.read(arm.safety_node, arm.safety, "MODE") == SafetyMode.ACTIVE:
        raise DriverError("the arm is active; press Shift-Idle on the pendant, lead it home, and zero it then")
    nodes = [one.puck.node for one in arm.pucks]
    before = port.positions(arm.motors, nodes)
    port.pause(_REST_SECONDS)
    after = port.positions(arm.motors, nodes)
    if missing := [node for node in nodes if node not in before or node not in after]:
        raise DriverError(f"no position of pucks {', '.join(map(str, missing))}")
    if moving := [node for node in nodes if abs(after[node] - before[node]) > _REST_COUNTS]:
        raise DriverError(
            f"the motors of pucks {', '.join(map(str, moving))} move; hold the arm still and zero it again"
        )
    port.write(arm.safety_node, arm.safety, "ZERO", 0)
    ignore_jumps(port, arm)
    told = []
    for one, counts in zip(arm.pucks, coordinates.counts_at(_array(home)), strict=True):
        shift = _encoder_error(port, one, counts)
        port.write(one.puck.node, one.properties, "P", counts - shift, verify=False)
        by = f", corrected by {shift} counts of its absolute encoder" if one.has_absolute_encoder else ""
        told.append(f"puck {one.puck.node}: home at {counts - shift} counts{by}")
    # The safety puck must have seen them before it counts the arm as zeroed.
    seen = port.positions(arm.motors, nodes)
    for one, counts in zip(arm.pucks, coordinates.counts_at(_array(home)), strict=True):
        slack = _REST_COUNTS + (one.puck.cts if one.has_absolute_encoder else 0)
        if abs(seen.get(one.puck.node, 1 << 30) - counts) > slack:
            raise DriverError(f"puck {one.puck.node} does not keep its position; the arm is not zeroed")
    port.write(arm.safety_node, arm.safety, "ZERO", 1)
    return tuple(told)


def _encoder_error(port: PropertyPort, one: FoundPuck, counts: int) -> int:
    """Return how far a motor stands from its home by its absolute encoder [counts]; 0 where it has none."""
    if one.puck.zero_angle is None or not one.has_absolute_encoder:
        return 0
    turn = one.puck.cts
    mech = port.read(one.puck.node, one.properties, "MECH")
    error = counts + round(one.puck.zero_angle * turn / (2.0 * math.pi)) - mech
    return (error + turn // 2) % turn - turn // 2


def _array(values: Sequence[float]) -> Vector:
    return np.array(values, dtype=float)
