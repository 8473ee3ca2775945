"""A small arm with emulated drives, and a plain host that knows CANopen by heart, for tests."""

from __future__ import annotations

import struct
from pathlib import Path

import yaml

from drivers.can.can_frame import Frame
from drivers.can.can_link import Link, open_links
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from sim_backend.emulator.lock_step import LockStepArm, LockStepLink
from sim_backend.machine import Truth

CONFIGS = Path(__file__).parents[2] / "configs"
EDS = CONFIGS / "emulated_drive.eds"
MS = 1_000_000
# A differential: both motors turn both joints.
GEARS = {"ratios": [20.0, -20.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "joints"}
HOST = 127


def drives_config(
    folder: Path, *, name: str = "planar2.yaml", gears: dict | None = None, brake: bool = False, **driver: object
) -> ArmConfig:
    """A shipped arm on emulated drives in virtual time; planar2 with a differential unless told otherwise."""
    transmission = GEARS if gears is None else gears
    drives = [
        {"node": k + 1, "rated_torque": 1.0, "max_torque": 30.0, "max_speed": 6000.0}
        for k in range(len(transmission["ratios"]))
    ]
    section = {"kind": "canopen", "eds": str(EDS), "buses": [{"interface": "lock_step"}], "drives": drives} | driver
    tree = {"extends": str(CONFIGS / name), "name": "drives", "transmission": transmission, "driver": section}
    if name == "planar2.yaml":
        tree["joints"] = {joint: {"brake": brake} for joint in ("shoulder", "elbow")}
    path = folder / "drives.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return load_arm(path)


class Host:
    """A host on one bus of emulated drives: everything by hand, nothing of the driver's."""

    def __init__(self, link: Link, nodes: tuple[int, ...] = (1, 2)) -> None:
        self.link, self.nodes = link, nodes
        self.heard: list[Frame] = []
        self.listen(5)

    @classmethod
    def on(cls, config: ArmConfig) -> Host:
        (link,) = open_links(config)
        return cls(link)

    @property
    def arm(self) -> LockStepArm:
        assert isinstance(self.link, LockStepLink)
        return self.link.arm

    @property
    def now(self) -> int:
        return self.link.clock.now_ns()

    def send(self, identifier: int, data: bytes = b"") -> None:
        self.link.send(Frame(identifier, data))

    def listen(self, milliseconds: float) -> list[Frame]:
        """Everything heard in this time."""
        end, frames = self.now + round(milliseconds * MS), []
        while (frame := self.link.receive(end)) is not None:
            frames.append(frame)
        return frames

    def ask(self, node: int, request: bytes) -> bytes:
        """One SDO exchange; whatever else is heard meanwhile is kept in `heard`."""
        self.send(0x600 + node, request)
        end = self.now + 20 * MS
        while (frame := self.link.receive(end)) is not None:
            if frame.identifier == 0x580 + node:
                return frame.data
            self.heard.append(frame)
        raise AssertionError(f"node {node} does not answer {request.hex()}")

    def write(self, node: int, index: int, subindex: int, form: str, value: int) -> int:
        """Download; returns 0, or the abort code."""
        data = struct.pack(f"<{form}", value)
        first = 0x23 | (4 - len(data)) << 2
        answer = self.ask(node, struct.pack("<BHB4s", first, index, subindex, data))
        return 0 if answer[0] == 0x60 else struct.unpack_from("<I", answer, 4)[0]

    def read(self, node: int, index: int, subindex: int, form: str) -> int:
        """Expedited upload of a number."""
        answer = self.ask(node, struct.pack("<BHB4x", 0x40, index, subindex))
        assert answer[0] & 0xE3 == 0x43, answer.hex()
        return struct.unpack_from(f"<{form}", answer, 4)[0]

    def map_pdo(self, node: int, parameter: int, identifier: int, kind: int, entries: list[int], **more: int) -> None:
        """Configure a PDO in the order of CiA 301, 7.5.2.36; `deadline` and `inhibit` as they go to sub 5 and 3."""
        steps = [(parameter, 1, "I", 1 << 31 | identifier), (parameter, 2, "B", kind)]
        steps += [(parameter, 3, "H", more["inhibit"])] if "inhibit" in more else []
        steps += [(parameter, 5, "H", more["deadline"])] if "deadline" in more else []
        steps += [(parameter + 0x200, 0, "B", 0)]
        steps += [(parameter + 0x200, k, "I", entry) for k, entry in enumerate(entries, 1)]
        steps += [(parameter + 0x200, 0, "B", len(entries)), (parameter, 1, "I", identifier)]
        for step in steps:
            assert self.write(node, *step) == 0, step

    def configure(self, *, deadline: int = 0, max_torque: int = 30000) -> None:
        """The map of FIELDBUS.md 2.3: shared torques in 201h, positions at every SYNC, status on change."""
        for slot, node in enumerate(self.nodes):
            slots = [0x00030010] * len(self.nodes)
            slots[slot] = 0x60710010
            self.map_pdo(node, 0x1400, 0x201, 1, slots, deadline=deadline)
            self.map_pdo(node, 0x1401, 0x300 + node, 255, [0x60400010, 0x60600008])
            assert self.write(node, 0x1402, 1, "I", 1 << 31 | 0x400 + node) == 0
            self.map_pdo(node, 0x1800, 0x180 + node, 1, [0x60640020])
            self.map_pdo(node, 0x1801, 0x280 + node, 255, [0x60410010, 0x60770010], inhibit=0)
            for index, subindex, form, value in (
                (0x6072, 0, "H", max_torque),
                (0x6076, 0, "I", 1000),
                (0x6080, 0, "I", 6000),
                (0x6007, 0, "h", 3),
            ):
                assert self.write(node, index, subindex, form, value) == 0
        self.send(0x000, b"\x01\x00")

    def control(self, word: int, nodes: tuple[int, ...] | None = None) -> None:
        """A controlword to each node, in mode 10."""
        for node in self.nodes if nodes is None else nodes:
            self.send(0x300 + node, struct.pack("<Hb", word, 10))

    def enable(self) -> None:
        """All nodes to operation enabled, with zero torque seeded; checks that they arrive."""
        self.torques(*[0] * len(self.nodes))
        self.send(0x080)
        for word in (0x06, 0x07, 0x0F):
            self.control(word)
        self.listen(1)
        assert [state & 0x6F for state in self.statuswords()] == [0x27] * len(self.nodes)

    def statuswords(self) -> list[int]:
        return [self.read(node, 0x6041, 0, "H") for node in self.nodes]

    def torques(self, *values: int) -> None:
        self.send(0x201, struct.pack(f"<{len(values)}h", *values))

    def cycle(self, *values: int, period: float = 1.0) -> dict[int, int]:
        """Torques, SYNC, then the positions [counts] that come until the end of the period, by node."""
        if values:
            self.torques(*values)
        self.send(0x080)
        frames = self.listen(period)
        self.heard += [f for f in frames if not 0x181 <= f.identifier < 0x200]
        return {f.identifier - 0x180: struct.unpack("<i", f.data)[0] for f in frames if 0x181 <= f.identifier < 0x200}

    def truths(self) -> list[Truth]:
        """A list that fills with the truth of every SYNC from now on."""
        found: list[Truth] = []
        self.arm.emulator.observer = found.append
        return found

    def emergencies(self) -> list[tuple[int, int]]:
        """Node and code of all emergency messages in `heard`."""
        return [
            (f.identifier - 0x80, struct.unpack_from("<H", f.data)[0])
            for f in self.heard
            if 0x80 < f.identifier < 0x100
        ]
