"""Exchange positions and torques with all pucks of an arm, cycle by cycle, and keep what each reports of itself.

A cycle begins with one GET of the position to the whole arm, which every puck answers, and with one or two frames of
torques right behind it. A puck samples its encoder about 75 us after it was asked, when the first torque frame has just
passed, so that position and change of torque are of one time, to about 0.15 ms. Positions carry no number: those that
came before the request are dropped, one that comes second or late is not used, and of which request one is that comes
behind a missing one `drivers/can/answer_order.py` tells.

MODE, STAT and the pendant are asked for beside the cycle, behind its positions, one or a few properties at a time: what
was asked of the safety puck comes between what was asked of the others. The safety puck watches positions and torques,
so that this loop alone keeps it quiet.

The budget counts all of this (`drivers/can/bus_load.py`): typical values are positions within ten motor turns of zero,
torques of up to 500 counts.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache

from drivers.axis_status import AxisStatus
from drivers.barrett.protocol import (
    HOST,
    Group,
    Mode,
    Pendant,
    Position,
    Properties,
    Reply,
    Role,
    SafetyMode,
    Status,
    address_of,
    decoded,
    get_frame,
    pendant_of,
    pendant_value,
    position_frame,
    reply_frame,
    torque_frame,
)
from drivers.barrett.setup import TIMEOUT
from drivers.can.answer_order import AnswerOrder, settle_uncertain
from drivers.can.bus_load import ROUND_RATES, Budget, BusLoad, Line, line_of, load_text, mean_bits, most_bits
from drivers.can.bus_state import HOST as BUS
from drivers.can.bus_state import (
    LEFT_NORMAL,
    MILD,
    ControllerState,
    Event,
    EventCode,
    controller_state,
    error_words,
    overflowed,
)
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from ident_service.config.barrett import BarrettDriver
from ident_service.errors import DriverError

_RECEIVE = 0.97  # of a period, within which a position counts for its cycle
_LEAST = 0.5  # of a period, from the request on, that positions are waited for in any case
_MISSED = 0.25  # of a period late, and the slot is left to the next
_DOUBT = 0.25  # of a period: sending a request takes less, unless this computer stalls
_MOST_EVENTS = 256  # that wait to be taken; a flood must neither eat the memory nor hide what matters
_OF_SAFETY = 3  # questions a status period: MODE twice, and the pendant
_STALE = 5.0  # status periods without an answer
_CONTROLLER = {ControllerState.PASSIVE: EventCode.ERROR_PASSIVE, ControllerState.BUS_OFF: EventCode.BUS_OFF}


@dataclass(slots=True)
class MotorPuck:
    """Hold the last known state of one motor puck.

    Attributes:
        node: node number.
        position: position of the last answer [counts], as a signed number of 22 bits.
        encoder: position of the joint encoder in the last answer [counts], as a signed number of 22 bits; None where it
            has told none.
        answered: whether it has answered in this cycle.
        age: cycles since the request that `position` is of, 0 where that is the latest one.
        late: positions that came outside of the cycle that they are of, or second in one.
        order: order that tells which request an answer belongs to.
        mode: MODE; None while unknown.
        stat: STAT; None while unknown.
        status_age: cycles since the last answer about MODE.
    """

    node: int
    position: int = 0
    encoder: int | None = None
    answered: bool = False
    age: int = 0
    late: int = 0
    order: AnswerOrder = field(default_factory=AnswerOrder)
    mode: int | None = None
    stat: int | None = None
    status_age: int = 0


@dataclass(slots=True)
class SafetyPuck:
    """Hold the last known state of the safety puck: MODE, what the pendant shows, cycles since the last answer."""

    node: int
    mode: int | None = None
    pendant: Pendant = field(default_factory=Pendant)
    status_age: int = 0


class PuckCodec:
    """Decode what pucks send, and encode what is sent to them in a cycle; there is no I/O, clock or decision here.

    `receive` takes any frame and never raises.

    Attributes:
        pucks: the motor pucks, in the arm's order.
        safety: the safety puck.
        controller: state of the host's CAN controller.
        unexplained: cycles since an arm was seen to leave ACTIVE while the pendant has not said why; None for no such.
    """

    def __init__(self, driver: BarrettDriver, motors: Properties, safety: Properties, period: float) -> None:
        """Start with pucks of unknown state.

        Args:
            driver: the section `driver`.
            motors: numbers of the motor pucks' properties.
            safety: numbers of the safety puck's properties.
            period: of a cycle [s].
        """
        self.pucks = tuple(MotorPuck(puck.node, order=AnswerOrder(period)) for puck in driver.pucks)
        self.safety = SafetyPuck(driver.safety_node)
        self.unexplained: int | None = None
        self._waits_for: set[int] = set()
        self.controller = ControllerState.ACTIVE
        self.request = get_frame(Group.ARM, motors.number("P"), group=True)
        self._torque = motors.number("T")
        self._mode, self._stat = motors.number("MODE"), motors.number("STAT")
        self._safety = safety
        self._slots = [
            (group, [(puck.slot - 1, number) for number, puck in enumerate(driver.pucks) if puck.group == group])
            for group in (Group.LOWER, Group.UPPER)
        ]
        self._slots = [(group, members) for group, members in self._slots if members]
        self._by_node = {puck.node: puck for puck in self.pucks}
        self._open, self._missing, self._now_ns = False, len(self.pucks), 0
        self._events: list[Event] = []
        self._told: set[int] = set()

    @property
    def late_count(self) -> int:
        """Return how many positions came too late or a second time in a cycle, of all pucks together."""
        return sum(puck.late for puck in self.pucks)

    @property
    def complete(self) -> bool:
        """Return whether every puck has answered in this cycle."""
        return self._missing == 0

    def torque_frames(self, torque_counts: Sequence[int]) -> list[Frame]:
        """Return a frame per group of pucks with torques [counts], given in the arm's order; DriverError if too big."""
        frames = []
        for group, members in self._slots:
            slots = [0, 0, 0, 0]
            for slot, number in members:
                slots[slot] = torque_counts[number]
            frames.append(torque_frame(group, self._torque, slots))
        return frames

    @property
    def safety_questions(self) -> list[Frame]:
        """Return the frames that ask the safety puck for MODE and PEN: why the arm is not active."""
        return [get_frame(self.safety.node, self._safety.number(name)) for name in ("MODE", "PEN")]

    def questions(self) -> list[Frame]:
        """Return the frames that ask all pucks for MODE, those not in torque mode for STAT, the safety puck for PEN."""
        mode = get_frame(self.safety.node, self._safety.number("MODE"))
        pendant = get_frame(self.safety.node, self._safety.number("PEN"))
        frames = [mode]
        for number, puck in enumerate(self.pucks):
            frames.append(get_frame(puck.node, self._mode))
            if puck.mode != Mode.TORQUE:  # one that follows torques has no error
                frames.append(get_frame(puck.node, self._stat))
            if number == len(self.pucks) // 2:
                frames.append(mode)
        return [*frames, pendant]

    def begin_cycle(self, now_ns: int = 0, *, positions_requested: bool = True) -> None:
        """Begin a cycle after positions were requested: each puck may answer once, and its data is a cycle older.

        Args:
            now_ns: time of the requests [ns of the link's clock].
            positions_requested: whether positions were asked for at all.
        """
        self._open, self._now_ns, self._missing = True, now_ns, len(self.pucks)
        self.safety.status_age += 1
        if self.unexplained is not None:
            self.unexplained += 1
        for puck in self.pucks:
            puck.answered = False
            puck.age += 1
            puck.status_age += 1
            puck.order.behind += positions_requested

    def end_cycle(self) -> None:
        """End the cycle at its deadline: uncertain answers are decided on, and answers from now on are late."""
        self._open = False
        if self._missing:
            self._missing -= settle_uncertain(self.pucks, self._tell)

    def take_events(self) -> list[Event]:
        """Return the events since the last call, oldest first, and forget them."""
        taken, self._events = self._events, []
        return taken

    def forget_events(self) -> None:
        """Discard all events, but queue again that the CAN controller is in trouble; stray frames can be told again."""
        self._events = []
        self._told.clear()
        if self.controller in LEFT_NORMAL:
            self._tell_controller()

    def receive(self, frame: Frame) -> None:
        """Take one received frame, whatever it is, into the state of the pucks or of the controller; never raises."""
        if frame.error:
            self._on_error(frame)
            return
        if frame.extended or frame.remote:
            return
        answer = decoded(frame)
        if isinstance(answer, Position):
            self._on_position(answer, frame.stamp_ns)
        elif isinstance(answer, Reply):
            self._on_reply(answer)
        else:
            self._on_other(frame)

    def _on_position(self, answer: Position, stamp_ns: int) -> None:
        puck = self._by_node.get(answer.node)
        if puck is None:
            self._tell_once(answer.node, EventCode.STRANGER, "a position of a puck that is not ours")
        elif not self._open:
            puck.late += 1
            puck.order.take_late()
            self._tell(EventCode.LATE, puck.node, "its position came after its cycle")
        elif (age := puck.order.take_answer(stamp_ns - self._now_ns if stamp_ns else None)) is None:
            puck.late += 1
            self._tell(EventCode.DUPLICATE, puck.node, "a second position in one cycle")
        else:
            puck.position, puck.encoder, puck.age = answer.counts, answer.encoder, age
            if age == 0:
                puck.answered = True
                self._missing -= 1

    def _on_reply(self, answer: Reply) -> None:
        if (puck := self._by_node.get(answer.node)) is not None:
            if answer.number == self._mode:
                if puck.mode == Mode.TORQUE and answer.value != Mode.TORQUE:
                    self._ask_why()
                    self._tell(EventCode.DRIVE_STATE, puck.node, f"MODE {answer.value}, was {puck.mode}")
                puck.mode, puck.status_age = answer.value, 0
                if answer.value == Mode.TORQUE:
                    puck.stat = Status.READY
            elif answer.number == self._stat:
                if answer.value == Status.RESET and puck.stat not in (None, Status.RESET):
                    self._tell(EventCode.BOOT_UP, puck.node, "has restarted (STAT 0)")
                puck.stat = answer.value
        elif answer.node == self.safety.node:
            self.safety.status_age = 0
            if answer.number == self._safety.number("MODE"):
                if self.safety.mode == SafetyMode.ACTIVE and answer.value != SafetyMode.ACTIVE:
                    self._ask_why()
                self.safety.mode = answer.value
            elif answer.number == self._safety.number("PEN"):
                self._on_pendant(pendant_of(answer.value))
            self._waits_for.discard(answer.number)
            if not self._waits_for:
                self.unexplained = None

    def _ask_why(self) -> None:
        if self.unexplained is None:
            self.unexplained = 0
            self._waits_for = {self._safety.number("MODE"), self._safety.number("PEN")}

    def _on_pendant(self, shown: Pendant) -> None:
        before, self.safety.pendant = self.safety.pendant, shown
        if new := [cause for cause in shown.warnings if cause not in before.warnings]:
            self._tell(EventCode.DRIVE_WARNING, self.safety.node, f"the pendant shows {' and '.join(new)} warning")
        # An e-stop shows in MODE as well, and a lost heartbeat is the watchdog's.
        if new := [one for one in shown.faults if one not in before.faults and one not in ("e-stop", "heartbeat")]:
            self._tell(EventCode.EMERGENCY, self.safety.node, f"the pendant shows {' and '.join(new)} fault")

    def _on_other(self, frame: Frame) -> None:
        address = address_of(frame.identifier)
        if address.sender == HOST:
            words = f"somebody else sends frames {frame.identifier:03X}h, which only this host may"
            self._tell_once(frame.identifier, EventCode.SECOND_HOST, words)
        elif address.sender in self._by_node and address.destination == Group.POSITIONS:
            words = f"position frame {frame.identifier:03X}h of {len(frame.data)} bytes instead of 3 or 6"
            self._tell(EventCode.WRONG_LENGTH, address.sender, words)

    def _on_error(self, frame: Frame) -> None:
        before, self.controller = self.controller, controller_state(frame, self.controller)
        if self.controller is not before:
            self._tell_controller()
        if overflowed(frame):
            self._tell(EventCode.OVERFLOW, BUS, "frames were lost in the host's CAN controller")
        if words := error_words(frame):
            self._tell(EventCode.BUS_ERROR, BUS, words)

    def _tell_controller(self) -> None:
        words = f"the host's CAN controller is {self.controller.name.lower().replace('_', '-')}"
        self._tell(_CONTROLLER.get(self.controller, EventCode.CONTROLLER), BUS, words)

    def _tell_once(self, what: int, code: EventCode, words: str) -> None:
        if what not in self._told:
            self._told.add(what)
            self._tell(code, BUS if code is EventCode.SECOND_HOST else what, words)

    def _tell(self, code: EventCode, node: int, words: str) -> None:
        if len(self._events) < (_MOST_EVENTS if code in MILD else 2 * _MOST_EVENTS):
            self._events.append(Event(code, node, words))


def axis_status(puck: MotorPuck, safety: SafetyPuck) -> AxisStatus:
    """Return a puck's status flags: POWERED alone where it follows torques, else IDLE and what is wrong."""
    found = AxisStatus(0)
    if safety.mode == SafetyMode.ESTOP:
        found |= AxisStatus.EMERGENCY_STOP
    if puck.stat == Status.ERROR:
        found |= AxisStatus.FAULT
    for cause in safety.pendant.faults:
        # An e-stop shows in MODE; when that is left, the pendant may show it for a moment longer.
        found |= {"heartbeat": AxisStatus.WATCHDOG, "e-stop": AxisStatus(0)}.get(cause, AxisStatus.FAULT)
    if not found and puck.mode == Mode.TORQUE and safety.mode == SafetyMode.ACTIVE:
        return AxisStatus.POWERED
    return found | AxisStatus.IDLE


class PuckBus:
    """Run the cycles of one arm of pucks on an open link.

    Attributes:
        codec: of the pucks.
        clock: of the link.
        complete: whether every puck answered in the last cycle.
        lost: positions that did not come in their cycle, so far.
        stamp_doubt_ns: uncertainty of the last cycle's stamp, see `Sample`.
        silent: whether nothing is sent that the safety puck watches, so that it can be seen to act.
        looks: whether positions are asked for only where the arm is not active, as nobody drives it from here.
    """

    def __init__(self, link: Link, codec: PuckCodec, driver: BarrettDriver, period_ns: int) -> None:
        """Use an open link, which `close` closes; `period_ns` is of a cycle [ns]."""
        self.link, self.codec, self.clock = link, codec, link.clock
        self.complete = False
        self.lost = self.stamp_doubt_ns = 0
        self.silent = self.looks = False
        self._period_ns = period_ns
        frames = [1, *(8 for _ in codec.torque_frames([0] * len(codec.pucks)))]
        frames += [6 if puck.node in driver.joint_encoders else 3 for puck in codec.pucks]
        wire = sum(most_bits(length).seconds(driver.bus.bitrate) for length in frames)
        self._least_ns = round(min(max(_LEAST * period_ns, 1e9 * wire), _RECEIVE * period_ns))
        cycles = driver.status_period * 1e9 / period_ns
        asked = len(codec.pucks) + _OF_SAFETY  # of an active arm; one that is idle is asked for STAT, too
        self._every, self._at_once = max(1, int(cycles / asked)), max(1, math.ceil(asked / cycles))
        self._stale = round(_STALE * max(cycles, asked * self._every / self._at_once))
        self._questions: list[Frame] = []
        self._count = 0
        self._next_ns: int | None = None

    def close(self) -> None:
        """Close the link; never raises."""
        with suppress(Exception):
            self.link.close()

    @property
    def stale(self) -> list[int]:
        """Return the nodes that have not reported their MODE for too many cycles."""
        old = [puck.node for puck in self.codec.pucks if puck.status_age > self._stale]
        return old + ([self.codec.safety.node] if self.codec.safety.status_age > self._stale else [])

    def cycle(self, torque_counts: Sequence[int] | None, *, asks_safety: bool = False) -> int:
        """Wait for the next cycle and exchange its frames; return when positions were requested [ns of its clock].

        Args:
            torque_counts: torque of every puck [counts]; None for none.
            asks_safety: whether the safety puck's MODE is asked for in this very cycle, beside what is due.

        Raises:
            DriverError: the bus is gone, or torques that cannot be sent, of which none has been.
        """
        codec, link, clock = self.codec, self.link, self.clock
        begin_ns = clock.now_ns() if self._next_ns is None else self._next_ns
        clock.sleep_until_ns(begin_ns)
        while (late_ns := clock.now_ns() - begin_ns) > _MISSED * self._period_ns:
            # Pucks go on with the torque that they have.
            begin_ns += -(-late_ns // self._period_ns) * self._period_ns
            clock.sleep_until_ns(begin_ns)
        self._next_ns = begin_ns + self._period_ns
        torques = [] if torque_counts is None else codec.torque_frames(torque_counts)
        for heard in link.drain():
            codec.receive(heard)
        if self.looks:
            self._require_inactive()
        before_ns = clock.now_ns()
        # What is withheld is withheld until the safety puck has acted.
        silent = self.silent and codec.safety.mode == SafetyMode.ACTIVE
        if not silent:
            link.send(codec.request)
        stamp_ns = clock.now_ns()
        if not silent:
            for frame in torques:
                link.send(frame)
        self.stamp_doubt_ns = stamp_ns - before_ns if stamp_ns - before_ns > _DOUBT * self._period_ns else 0
        codec.begin_cycle(stamp_ns, positions_requested=not silent)
        deadline = max(begin_ns + round(_RECEIVE * self._period_ns), stamp_ns + self._least_ns)
        while not codec.complete:
            answer = link.receive(deadline)
            if answer is None:
                break
            codec.receive(answer)
        codec.end_cycle()
        self.complete = codec.complete
        if not self.complete:
            self.lost += sum(not puck.answered for puck in codec.pucks)
        self._ask(asks_safety or silent)  # its watchdog is tried; MODE it does not watch
        return stamp_ns

    def answers_late(self) -> bool:
        """Leave out one cycle's request; return whether positions came nevertheless: answers are a request late."""
        before = self.codec.late_count
        self._next_ns = (self._next_ns or 0) + self._period_ns
        self.cycle(None)
        return self.codec.late_count > before

    def _require_inactive(self) -> None:
        """Raise DriverError unless the safety puck says, now, that the arm is not active."""
        safety, question = self.codec.safety, self.codec.safety_questions[0]
        self.link.send(question)
        until_ns = self.clock.now_ns() + round(TIMEOUT * 1e9)
        while (frame := self.link.receive(until_ns)) is not None:
            self.codec.receive(frame)
            answer = decoded(frame)
            if isinstance(answer, Reply) and (answer.node, answer.number) == (safety.node, question.data[0]):
                break
        else:
            raise DriverError("the safety puck does not answer")
        if safety.mode == SafetyMode.ACTIVE:
            raise DriverError(
                "the arm is active: another host drives it, and questions from here would keep its heartbeat quiet"
            )

    def _ask(self, asks_safety: bool) -> None:
        if self.codec.unexplained is not None:
            for frame in self.codec.safety_questions:
                self.link.send(frame)
        elif asks_safety:
            self.link.send(self.codec.safety_questions[0])
        self._count += 1
        if self._count % self._every:
            return
        for _ in range(self._at_once):
            self._questions = self._questions or self.codec.questions()
            self.link.send(self._questions.pop(0))


_NEWEST = Properties(0x7FFF, Role.MOTOR)
_SAFETY = Properties(0x7FFF, Role.SAFETY)
_COUNTS, _TORQUE = 40_000, 500


def budget(driver: BarrettDriver, rate: float) -> Budget:
    """Return the bus load of an arm's frames at a rate [Hz], with remedies where it does not fit.

    Args:
        driver: the arm's section `driver`.
        rate: cycles per second.
    """
    plain = _budget(driver, rate)
    return plain if plain.fits else Budget(rate, plain.buses, tuple(_remedies(driver, rate, plain)))


def _budget(driver: BarrettDriver, rate: float) -> Budget:
    return Budget(rate, (BusLoad(0, driver.bus, tuple(_lines(driver, rate))),))


def _remedies(driver: BarrettDriver, rate: float, plain: Budget) -> Iterator[str]:
    if slower := next((one for one in ROUND_RATES if one <= min(plain.highest_rate, rate)), None):
        yield f"run at {slower} Hz (control.rate): {load_text(_budget(driver, float(slower)).buses[0])}"


def _lines(driver: BarrettDriver, rate: float) -> Iterator[Line]:
    bus, often = driver.bus, 1.0 / driver.status_period
    request = get_frame(Group.ARM, _NEWEST.number("P"), group=True).identifier
    yield line_of("request for positions", (request,), 1, rate, bus, _of_request, cyclic=True)
    for length, whose in ((3, "positions"), (6, "positions with joint encoders")):
        nodes = [puck.node for puck in driver.pucks if (puck.node in driver.joint_encoders) == (length == 6)]
        identifiers = tuple(position_frame(node, 0).identifier for node in nodes)
        if identifiers:
            mean = _of_position if length == 3 else _of_positions
            yield line_of(whose, identifiers, length, rate, bus, mean, cyclic=True)
    groups = sorted({puck.group for puck in driver.pucks})
    torques = tuple(torque_frame(group, 0, ()).identifier for group in groups)
    yield line_of("torques", torques, 8, rate, bus, _of_torques, cyclic=True)
    for whose, nodes, times in (
        ("MODE of pucks", [puck.node for puck in driver.pucks], 1.0),
        ("MODE of the safety puck", [driver.safety_node], 2.0),
    ):
        asked = tuple(get_frame(node, 0).identifier for node in nodes)
        answers = tuple(reply_frame(node, 0, 0, wide=False).identifier for node in nodes)
        yield line_of(f"asks {whose}", asked, 1, times * often, bus, _of_question)
        yield line_of("answers", answers, 4, times * often, bus, _of_answer)
    yield line_of("asks for the pendant", asked, 1, often, bus, _of_question)
    yield line_of("answer", answers, 6, often, bus, _of_pendant)


@lru_cache(maxsize=64)
def _of_request(identifier: int) -> tuple[float, float]:
    return mean_bits(identifier, lambda draw: get_frame(0, _NEWEST.number("P")).data)


@lru_cache(maxsize=64)
def _of_position(identifier: int) -> tuple[float, float]:
    return mean_bits(identifier, lambda draw: position_frame(1, _counts(draw)).data)


@lru_cache(maxsize=64)
def _of_positions(identifier: int) -> tuple[float, float]:
    return mean_bits(identifier, lambda draw: position_frame(1, _counts(draw), _counts(draw)).data)


@lru_cache(maxsize=64)
def _of_torques(identifier: int) -> tuple[float, float]:
    def draw(source: random.Random) -> bytes:
        torques = [source.randint(-_TORQUE, _TORQUE) for _ in range(4)]
        return torque_frame(Group.LOWER, _NEWEST.number("T"), torques).data

    return mean_bits(identifier, draw)


@lru_cache(maxsize=64)
def _of_question(identifier: int) -> tuple[float, float]:
    return mean_bits(identifier, lambda draw: get_frame(0, _NEWEST.number("MODE")).data)


@lru_cache(maxsize=64)
def _of_answer(identifier: int) -> tuple[float, float]:
    modes = (Mode.TORQUE, SafetyMode.ACTIVE)
    return mean_bits(
        identifier, lambda draw: reply_frame(0, _NEWEST.number("MODE"), draw.choice(modes), wide=False).data
    )


@lru_cache(maxsize=64)
def _of_pendant(identifier: int) -> tuple[float, float]:
    shown = pendant_value(Pendant(activate_light=True, digit="0"))
    return mean_bits(identifier, lambda draw: reply_frame(0, _SAFETY.number("PEN"), shown, wide=True).data)


def _counts(draw: random.Random) -> int:
    return draw.randint(-_COUNTS, _COUNTS)
