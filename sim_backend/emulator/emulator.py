"""Emulate drives on their buses, with one arm behind them: frames and times in, frames out.

It has neither a clock nor a bus: `lock_step.py` runs it in virtual time, `process.py` on real interfaces. Callers call
`tick` for what is due before they hand over what has come since.

Faults of the configuration count from the first SYNC. The arm is supported where it stands when its host has switched
all drives off and has left in order; after anything else it sinks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from drivers.can.can_frame import Frame
from ident_service.errors import DriverError
from sim_backend.emulator.body import Body
from sim_backend.emulator.face import Companion, EmulatedDevice, Traffic
from sim_backend.emulator.faults import DriveFault, Injection, Sent
from sim_backend.machine import Truth

# An arm that moves is brought forward this often when nothing else happens [ns].
_IDLE_NS = 20_000_000


class Emulator:
    """Emulate all drives of an arm.

    Attributes:
        body: the arm.
        faces: the drives' protocol implementations, in the order of the motors.
        names: of the joints.
        companions: devices on the first bus that move no motor.
        observer: called with the truth at every SYNC, when the last bus has had it.
    """

    def __init__(
        self,
        body: Body,
        faces: Sequence[EmulatedDevice],
        buses: Sequence[int],
        names: Sequence[str],
        faults: Sequence[DriveFault] = (),
        companions: Sequence[Companion] = (),
    ) -> None:
        """Assemble the emulator; nothing has power yet.

        Args:
            body: the arm.
            faces: the drives' protocol implementations, in the order of the motors.
            buses: index of each one's bus.
            names: of the joints.
            faults: to inject, counted from the first SYNC.
            companions: devices on the first bus that move no motor.
        """
        self.companions = tuple(companions)
        self.body, self.faces, self.names = body, tuple(faces), tuple(names)
        self.observer: Callable[[Truth], None] | None = None
        self._buses = tuple(buses)
        self._on_bus: dict[int, list[tuple[int, EmulatedDevice]]] = {bus: [] for bus in self._buses}
        for drive, face in enumerate(self.faces):
            self._on_bus[self._buses[drive]].append((drive, face))
        self._injection = Injection(body, self.faces, self._buses)
        self._period_ns = round(body.plant.period * 1e9)
        self._configured: tuple[DriveFault, ...] = tuple(faults)
        self._to_begin: list[tuple[int, int | None, DriveFault]] = []
        self._to_end: list[tuple[int, DriveFault]] = []
        self._synced: set[int] = set()
        self._now_ns = 0
        self._deadline: tuple[int | None] | None = None  # as computed last, while it holds
        body.watch = self._watch

    @property
    def gone(self) -> bool:
        """Return whether a `bus_gone` fault acts, by which no frame gets through."""
        return any(fault.kind == "bus_gone" for fault in self._injection.active)

    @property
    def states(self) -> tuple[str, ...]:
        """Describe the state of each drive, then of each companion, a safety puck say, in words."""
        drives = ("dead" if self._injection.dead(drive) else face.state for drive, face in enumerate(self.faces))
        return (*drives, *(companion.state for companion in self.companions))

    @property
    def labels(self) -> tuple[str, ...]:
        """Return a label for each entry of `states`: a drive's name and node number, or the safety node."""
        drives = (f"{name}, node {face.number}" for name, face in zip(self.names, self.faces, strict=True))
        return (*drives, *(f"safety, node {companion.number}" for companion in self.companions))

    def is_feedback(self, sent: Sent) -> bool:
        """Return whether a frame that is being sent is a drive's position feedback."""
        return sent.drive is not None and self.faces[sent.drive].traffic_kind(sent.frame) is Traffic.FEEDBACK

    @property
    def active(self) -> tuple[DriveFault, ...]:
        """Return the faults that act at present."""
        return tuple(self._injection.active)

    @property
    def next_deadline_ns(self) -> int | None:
        """Return when `tick` is next due [ns]: for a timer, a fault or the plant in motion; None for never."""
        if self._deadline is not None:
            return self._deadline[0]
        times = [begin for begin, _, _ in self._to_begin] + [end for end, _ in self._to_end]
        for drive, face in enumerate(self.faces):
            deadline = face.next_deadline_ns
            if deadline is not None and not self._injection.dead(drive):
                times.append(deadline)
        times += [due for one in self.companions if (due := one.next_deadline_ns) is not None]
        if not self.body.supported:
            times.append(self.body.now_ns + _IDLE_NS)
        self._deadline = (min(times, default=None),)
        return self._deadline[0]

    def power_up(self, now_ns: int) -> None:
        """Give power to all drives; they send their boot-up messages with the next `tick`."""
        self._now_ns = now_ns
        self.body.set_clock(now_ns)
        for face in self.faces:
            face.power_up(now_ns)
        for companion in self.companions:
            companion.power_up(now_ns)
        self._deadline = None

    def receive(
        self,
        bus: int,
        frame: Frame,
        now_ns: int,
        sender: int | None = None,
        answer: Callable[[list[Sent]], object] | None = None,
    ) -> list[Sent]:
        """Deliver a frame to a bus's devices; return the frames they send, but answers to a SYNC to `answer`, if given.

        Args:
            bus: index of the bus.
            frame: frame of any kind.
            now_ns: time of reception.
            sender: the drive that sent it, which does not hear it; None for the host.
            answer: given the answers to a SYNC before torques act, for a host that waits for them; None to have them
                returned with the rest.

        Returns:
            What else the drives send, in order.

        Raises:
            DriverError: the plant ran away.
        """
        self._now_ns = now_ns = max(now_ns, self._now_ns)
        if self._injection.cut_off:
            return []
        self.body.catch_up(now_ns)
        sent: list[Sent] = []
        synced: list[tuple[int, EmulatedDevice]] = []
        for drive, face in self._on_bus.get(bus, ()):
            if face.listens(frame.identifier) and drive != sender and not self._injection.dead(drive):
                self._deadline = None
                if frame.identifier == face.sync_identifier:
                    synced.append((drive, face))
                sent += self._injection.apply_to_frames(drive, face.receive(frame, now_ns), now_ns)
        if synced and answer is not None:
            answer(sent)
            sent = []
        for drive, face in synced:
            sent += self._injection.apply_to_frames(drive, face.finish_sync(now_ns), now_ns)
        for companion in self.companions if bus == 0 and sender is None else ():
            if companion.listens(frame.identifier):
                self._deadline = None
                sent += [Sent(bus, None, answer, now_ns) for answer in companion.receive(frame, now_ns)]
        if not self.body.supported and all(face.released for face in self.faces):
            self.body.support(now_ns)
            self._deadline = None
        if synced and not (frame.error or frame.remote or frame.extended):
            self._sync(bus, now_ns)
        return sent

    def tick(self, now_ns: int) -> list[Sent]:
        """Process faults and timers that are due until `now_ns`, in order of time; return the frames that are sent.

        Raises:
            DriverError: the plant ran away.
        """
        sent: list[Sent] = []
        while (due := self.next_deadline_ns) is not None and due <= now_ns:
            at = self._now_ns = max(due, self._now_ns)
            if self.body.now_ns + _IDLE_NS <= at:
                self.body.advance(at)
            self.body.catch_up(at)
            sent += self._faults_due(at)
            for drive, face in enumerate(self.faces):
                deadline = face.next_deadline_ns
                if deadline is not None and deadline <= at and not self._injection.dead(drive):
                    sent += self._injection.apply_to_frames(drive, face.tick(at), at)
            for companion in self.companions:
                due = companion.next_deadline_ns
                if due is not None and due <= at:
                    sent += [Sent(0, None, frame, at) for frame in companion.tick(at) if not self._injection.cut_off]
            self._deadline = None
        self._now_ns = max(now_ns, self._now_ns)
        return sent

    def press(self, key: str, now_ns: int) -> None:
        """Press a key of the pendant, `activate` or `idle`; does nothing on an arm without one."""
        for companion in self.companions:
            companion.press(key, now_ns)
        self._deadline = None

    def compute_ahead(self, now_ns: int) -> None:
        """Compute the arm's next step in advance, or advance the arm now where its cycle is overdue.

        Moving the arm takes longest; without this the answers to each cycle would come later, and late ones late.
        """
        overdue = self.body.overdue_ns
        if overdue is None or now_ns < overdue:
            self.body.prepare()
        else:
            self.body.advance(now_ns)
            self._watch(now_ns)
            self._now_ns = max(now_ns, self._now_ns)
            self._deadline = None

    def inject(self, faults: Iterable[DriveFault], now_ns: int) -> None:
        """Schedule faults, counted from now on, which take effect with `tick`; DriverError for an unknown drive."""
        for fault in faults:
            if fault.drive is not None and not 0 <= fault.drive < len(self.faces):
                raise DriverError(f"{fault} is of no drive")
            begin, end = fault.window(now_ns, self._period_ns)
            self._to_begin.append((begin, end, fault))
        self._deadline = None

    def add_configured(self, faults: Iterable[DriveFault]) -> None:
        """Schedule faults that are counted from the next SYNC, besides those of the configuration."""
        self._configured += tuple(faults)

    def clear(self, now_ns: int) -> None:
        """End acting faults with the next `tick`, and drop those that are to begin."""
        self._configured = ()
        self._to_begin.clear()
        self._to_end = [(now_ns, fault) for fault in self._injection.active]
        self._deadline = None

    def _faults_due(self, now_ns: int) -> list[Sent]:
        sent: list[Sent] = []
        for ends in [item for item in self._to_end if item[0] <= now_ns]:
            self._to_end.remove(ends)
            sent += self._injection.end(ends[1], now_ns)
        for begins in [item for item in self._to_begin if item[0] <= now_ns]:
            self._to_begin.remove(begins)
            _, end, fault = begins
            sent += self._injection.begin(fault, now_ns)
            if end is not None:
                self._to_end.append((end, fault))
        return sent

    def _sync(self, bus: int, now_ns: int) -> None:
        if self._configured:
            self.inject(self._configured, now_ns)
            self._configured = ()
        if bus in self._synced:
            self._synced.clear()
        self._synced.add(bus)
        if self.observer is not None and self._synced == set(self._buses):
            self.observer(self.body.truth(now_ns))

    def _watch(self, now_ns: int) -> None:
        for drive, face in enumerate(self.faces):
            if not self._injection.dead(drive):
                face.watch(now_ns)
