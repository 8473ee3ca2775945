"""Emulate drives in this process and in virtual time: a link without a bus.

A frame is as long as the standard says without stuff bits, with its space, on a bus of CAN
FD that of CAN FD; remote frames have no data. Nodes have priority mailboxes: of what one drive wants to send, the
lowest identifier goes first, too.

All buses of an arm share one emulator, one arm and one clock. Nothing happens but by calls: `receive` moves the clock
to the next frame, or to its deadline; whoever moves the clock otherwise finds at the next call that the drives have
done what was due meanwhile.

What the host sends acts when it is sent, so that a cycle is as long for the arm as it is for the host, and takes its
time on the wire, so that the answers come no earlier than they would. What the drives send arrives in the order of
arbitration, after its time on the wire.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from drivers.can.bus_load import unstuffed_bits
from drivers.can.can_frame import Frame
from drivers.clock import VirtualClock
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from sim_backend.emulator.build import build_emulator
from sim_backend.emulator.faults import DriveFault, Sent

_CLASSIC = 8  # bytes of a classic frame, at most


class LockStepBus:
    """Emulate one bus."""

    def __init__(self, bitrate: int, data_bitrate: int | None = None) -> None:
        """Start with an idle bus of these bit rates [bit/s]; `data_bitrate` None for one without CAN FD."""
        self._rates, self.fd = (bitrate, data_bitrate), data_bitrate is not None
        self._durations: dict[tuple[int, bool], int] = {}
        self._free_ns = 0
        self._waiting: list[tuple[int, int, Sent]] = []
        self._count = 0
        self._found: tuple[int, tuple[int, int, Sent]] | None = None  # the next frame, while it is known

    def as_sent(self, frame: Frame) -> Frame:
        """Return the frame, marked as CAN FD where this bus is CAN FD and it is a data frame."""
        return frame._replace(fd=True) if self.fd and not (frame.remote or frame.error) else frame

    def duration_ns(self, frame: Frame) -> int:
        """Return the duration of a frame on this bus, without stuff bits [ns]."""
        # A length that only CAN FD has takes its bits on any bus: tests send such frames, no controller does.
        kind = len(frame.data), len(frame.data) > _CLASSIC or (self.fd and not (frame.remote or frame.error))
        if (known := self._durations.get(kind)) is None:
            bits, (bitrate, data_bitrate) = unstuffed_bits(kind[0], fd=kind[1]), self._rates
            known = self._durations[kind] = round(1e9 * bits.seconds(bitrate, data_bitrate or bitrate))
        return known

    def occupy(self, now_ns: int, frame: Frame) -> None:
        """Occupy the bus by a frame of the host for its duration, from when the bus is free."""
        self._free_ns = max(self._free_ns, now_ns) + self.duration_ns(frame)
        self._found = None

    def put(self, sent: Sent) -> None:
        """Queue a frame that a drive sends, until the bus is free for it."""
        self._waiting.append((sent.ready_ns, self._count, sent))
        self._count += 1
        self._found = None

    @property
    def next_ns(self) -> int | None:
        """Return when the next waiting frame will have been received [ns]; None when none waits."""
        found = self._next()
        return None if found is None else found[0]

    def take(self) -> Sent:
        """Remove and return the frame that `next_ns` is about; the bus is occupied until then."""
        found = self._next()
        assert found is not None  # noqa: S101 the caller has checked `next_ns`
        self._free_ns, item = found
        self._waiting.remove(item)
        self._found = None
        return item[2]

    def _next(self) -> tuple[int, tuple[int, int, Sent]] | None:
        """Return the frame that wins arbitration once the wire is free, with its end; None if none waits."""
        if self._found is not None or not self._waiting:
            return self._found
        start = max(self._free_ns, min(ready for ready, _, _ in self._waiting))
        winner = min(
            (item for item in self._waiting if item[0] <= start), key=lambda item: (item[2].frame.identifier, item[1])
        )
        self._found = start + self.duration_ns(winner[2].frame), winner
        return self._found


INTERFACE = "lock_step"


class LockStepArm:
    """Emulate the drives of one arm, their buses and their clock.

    Attributes:
        emulator: of the drives.
        clock: all links'.
    """

    def __init__(self, config: ArmConfig, faults: Sequence[DriveFault] = (), clock: VirtualClock | None = None) -> None:
        """Build the arm and power it up.

        Args:
            config: configuration whose buses are all of this interface.
            faults: to inject besides those of the configuration, counted from the first SYNC.
            clock: the loop's; by default a new one.

        Raises:
            DriverError: as `build_emulator`, or a bus of another interface.
        """
        buses = config.can_buses
        if any(bus.interface != INTERFACE for bus in buses):
            raise DriverError(f"{config.name}: either all buses are {INTERFACE!r} or none: one arm, one time")
        self.emulator = build_emulator(config, faults)
        self.clock = VirtualClock() if clock is None else clock
        self._wires = [LockStepBus(bus.bitrate, bus.data_bitrate) for bus in buses]
        self._heard: list[deque[Frame]] = [deque() for _ in buses]
        self._open: set[int] = set()
        self._now_ns = self.clock.now_ns()
        self.emulator.power_up(self._now_ns)

    def link(self, bus: int) -> LockStepLink:
        """Open one bus and return its link; DriverError where that bus is open already.

        Raises:
            DriverError: it is open already.
        """
        if bus in self._open:
            raise DriverError(f"bus {bus} is open already; one driver at a time can have the arm")
        self._open.add(bus)
        self._heard[bus].clear()
        return LockStepLink(self, bus)

    def inject(self, *faults: DriveFault) -> None:
        """Inject faults, counted from now on, and let those that are due begin."""
        self._run(self.clock.now_ns())
        self.emulator.inject(faults, self._now_ns)
        self._run(self._now_ns)

    def settle(self, until_ns: int) -> None:
        """Let virtual time pass until `until_ns` without a host; drives act on their timers and faults."""
        self.clock.sleep_until_ns(until_ns)
        self._run(self.clock.now_ns())

    def send(self, bus: int, frame: Frame) -> None:
        """Send a frame of the host: drives receive it now, and it occupies the bus for its duration."""
        self._run(self.clock.now_ns())
        self._require_bus(bus)
        frame = self._wires[bus].as_sent(frame)
        self._wires[bus].occupy(self._now_ns, frame)
        self._put_on_buses(self.emulator.receive(bus, frame, self._now_ns))

    def receive(self, bus: int, deadline_ns: int) -> Frame | None:
        """Return a bus's next frame and move the time to it; None, and time at the deadline, where none comes."""
        heard = self._heard[bus]
        self._run(self.clock.now_ns())
        while not heard:
            self._require_bus(bus)
            due, _ = self._due()
            if due is None or due > deadline_ns:
                self.clock.sleep_until_ns(deadline_ns)
                self._run(self.clock.now_ns())
                break
            self.clock.sleep_until_ns(due)
            self._run(due)
        self._require_bus(bus)
        return heard.popleft() if heard else None

    def drain(self, bus: int) -> list[Frame]:
        """Return all frames that have come on a bus until now, without moving the time."""
        self._run(self.clock.now_ns())
        self._require_bus(bus)
        frames = list(self._heard[bus])
        self._heard[bus].clear()
        return frames

    def leave(self, bus: int) -> None:
        """Close the link of a bus; the drives go on."""
        self._open.discard(bus)

    def _require_bus(self, bus: int) -> None:
        if bus not in self._open:
            raise DriverError(f"bus {bus} is closed")
        if self.emulator.gone:
            raise DriverError(f"bus {bus} is gone")

    def _due(self) -> tuple[int | None, int | None]:
        """Return when the next event happens, and the bus on which a frame arrives then, if it is an arrival."""
        due = arrived = None
        for bus, wire in enumerate(self._wires):
            time = wire.next_ns
            if time is not None and (due is None or time < due):
                due, arrived = time, bus
        deadline = self.emulator.next_deadline_ns
        if deadline is not None and (due is None or deadline < due):
            return deadline, None
        return due, arrived

    def _run(self, now_ns: int) -> None:
        """Process all events until this time, in their order."""
        while True:
            due, arrived = self._due()
            if due is None or due > now_ns:
                break
            self._now_ns = max(due, self._now_ns)
            if arrived is None:
                self._put_on_buses(self.emulator.tick(due))
            else:
                self._deliver(arrived, self._wires[arrived].take(), self._now_ns)
        self._now_ns = max(now_ns, self._now_ns)

    def _deliver(self, bus: int, sent: Sent, now_ns: int) -> None:
        if bus in self._open:
            self._heard[bus].append(self._wires[bus].as_sent(sent.frame)._replace(stamp_ns=now_ns))
        if sent.drive is not None:
            self._put_on_buses(self.emulator.receive(bus, sent.frame, now_ns, sent.drive))

    def _put_on_buses(self, sent: Sequence[Sent]) -> None:
        for item in sent:
            self._wires[item.bus].put(item)


class LockStepLink:
    """Implement a Link on one bus of emulated drives in virtual time.

    Attributes:
        arm: behind it; for tests and scoring.
    """

    def __init__(self, arm: LockStepArm, bus: int) -> None:
        """Use an arm; opened by `LockStepArm.link`."""
        self.arm = arm
        self._bus = bus
        self._closed = False

    @property
    def clock(self) -> VirtualClock:
        """Return the virtual clock of all buses of the arm."""
        return self.arm.clock

    def send(self, frame: Frame) -> None:
        """Send a frame: drives receive it now, and it occupies the bus for a while; DriverError if closed or gone."""
        self._require_open()
        self.arm.send(self._bus, frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the next frame, moving the time to it, or None at the deadline; DriverError if closed or gone."""
        self._require_open()
        return self.arm.receive(self._bus, deadline_ns)

    def drain(self) -> list[Frame]:
        """Return all frames that came until now; DriverError if the link is closed or the bus gone."""
        self._require_open()
        return self.arm.drain(self._bus)

    def close(self) -> None:
        """Close the link; the emulated drives go on; any number of times."""
        if not self._closed:
            self._closed = True
            self.arm.leave(self._bus)

    def _require_open(self) -> None:
        if self._closed:
            raise DriverError(f"bus {self._bus} is closed")


_standing: dict[int, LockStepArm] = {}


@contextmanager
def hold_emulated_arm(
    config: ArmConfig, faults: Sequence[DriveFault] = (), clock: VirtualClock | None = None
) -> Iterator[LockStepArm]:
    """Yield one emulated arm for the block, to which all links opened from this very configuration lead.

    While this lasts, every link that is opened from this very configuration object leads to it. Otherwise each opening
    of the first bus builds an arm anew.

    Args:
        config: of the arm.
        faults: to inject besides those of the configuration, counted from the first SYNC.
        clock: the loop's; by default a new one.

    Raises:
        DriverError: as `LockStepArm`, or such an arm is there already.
    """
    if id(config) in _standing:
        raise DriverError(f"{config.name}: its emulated arm is there already")
    _standing[id(config)] = LockStepArm(config, faults, clock)
    try:
        yield _standing[id(config)]
    finally:
        del _standing[id(config)]


# The arm whose further buses are about to be opened, and the configuration that they belong to.
_begun: tuple[ArmConfig, LockStepArm] | None = None


def from_config(config: ArmConfig, bus_number: int) -> LockStepLink:
    """Open a bus of emulated drives in virtual time; the first bus builds the arm, later ones lead to it.

    Args:
        config: of the arm.
        bus_number: number of the bus; the first bus builds the arm, the others, opened after it, lead to the same arm.

    Raises:
        DriverError: as `LockStepArm`, or buses that are not opened in their order.
    """
    global _begun
    arm = _standing.get(id(config))
    if arm is None:
        if bus_number == 0:
            _begun = (config, LockStepArm(config))
        if _begun is None or _begun[0] is not config:
            raise DriverError(f"{config.name}: bus {bus_number} was opened before bus 0")
        arm = _begun[1]
        if bus_number == len(config.can_buses) - 1:
            _begun = None
    return arm.link(bus_number)
