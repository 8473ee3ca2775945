"""Arms whose encoders count from where they were when power came: who may zero them, and when that is lost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from helpers.emulated_arms import EDS, Tapped, tapped, weightless_config

from drivers.arm import StopKind
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from drivers.canopen.object_dictionary import ZERO_COUNTS, ZERO_MARK
from drivers.canopen.pdo_mapping import SDO_REQUEST
from drivers.canopen.stored_zero import Zeros
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError, PositionUnknown
from sim_backend.canopen_device.drive import CanopenDrive
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm

HOME = np.array([0.5, 0.4])
# Both motors turn both joints, so that a joint's position depends on both zeros.
GEARS = {"ratios": [3.0, -2.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "joints"}
MS = 1_000_000


def config_at(home: Sequence[float] = HOME, gears: dict[str, Any] = GEARS, **driver: Any) -> ArmConfig:
    content = weightless_config(**({"zero": "at_home"} | driver)).model_dump(mode="json")
    for joint, position in zip(content["joints"].values(), home, strict=True):
        joint["home"] = position
    return ArmConfig.model_validate(content | {"transmission": gears})


class Bench:
    """Two emulated drives that were powered at one posture, and an arm on them that is told of its home."""

    def __init__(self, told: ArmConfig | None = None, powered_at: Sequence[float] = (-0.3, 0.9)) -> None:
        self.config = told or config_at()
        self.behind = LockStepArm(config_at(powered_at))
        self.taps: list[Tapped] = []
        self.loses = lambda frame: False
        self.arm = self.another(self.config)
        self.settle(50)

    def another(self, config: ArmConfig) -> CanopenArm:
        """The driver with another description, on the same drives."""
        return CanopenArm(config, self._links)

    def _links(self, config: ArmConfig) -> list[Tapped]:
        self.taps = tapped(self.behind, config)
        self.taps[0].loses = self.loses
        return self.taps

    def settle(self, milliseconds: int) -> None:
        self.behind.settle(self.behind.clock.now_ns() + milliseconds * MS)

    def lead(self, position: Sequence[float]) -> None:
        self.behind.emulator.body.lead(np.array(position), self.behind.clock.now_ns())

    def objects(self, number: int) -> Any:
        face = self.behind.emulator.faces[number]
        assert isinstance(face, CanopenDrive)
        return face.objects

    def marks(self) -> list[int]:
        return [self.objects(k).number(ZERO_MARK.index, ZERO_MARK.sub) for k in range(2)]

    def zeroed(self) -> Bench:
        """A person has led it home, and has said so."""
        self.lead(HOME)
        self.arm.zero()
        return self

    def sees(self) -> np.ndarray:
        """Where the arm says that it is."""
        with self.arm as arm:
            return arm.exchange(None).position

    def looks(self) -> np.ndarray:
        with self.arm.look() as arm:
            return arm.exchange(None).position

    def true(self) -> np.ndarray:
        return self.behind.emulator.body.plant.position


RESOLUTION = 2.0 * np.pi / 65536  # of joints, at most: one count of each motor, gears of more than 1


def close(position: np.ndarray, true: np.ndarray) -> None:
    np.testing.assert_allclose(position, true, rtol=0.0, atol=2.0 * RESOLUTION)


def test_drives_that_were_never_zeroed_are_not_opened_nor_looked_at() -> None:
    bench = Bench()
    for act in (bench.arm.open, bench.arm.look().open):
        with pytest.raises(PositionUnknown, match=r"drives 1, 2 do not know where.*`ident set-home ARM`"):
            act()
        bench.behind.link(0).close()  # given back
    assert bench.marks() == [0, 0]
    assert not any("enabled" in state for state in bench.behind.emulator.states)


def test_a_zeroed_arm_knows_where_it_stands_until_its_drives_lose_their_power() -> None:
    bench = Bench().zeroed()
    assert len(set(bench.marks())) == 2
    assert 0 not in bench.marks()
    for position in (HOME, (0.1, 0.3), (-0.6, 0.9)):
        bench.lead(position)
        close(bench.looks(), np.array(position))
        close(bench.sees(), np.array(position))
        close(bench.looks(), np.array(position))
    bench.behind.inject(DriveFault("reboot", 1))
    bench.settle(100)
    for act in (bench.arm.open, bench.arm.look().open):
        with pytest.raises(PositionUnknown, match=r"drives 2 do not know where"):
            act()
    bench.behind.inject(DriveFault("node_silent", 0, duration=0.01))  # its power goes and comes
    bench.settle(100)
    with pytest.raises(PositionUnknown, match=r"drives 1, 2 do not know where"):
        bench.arm.open()
    close(bench.zeroed().sees(), HOME)


def test_the_arm_moves_and_is_where_it_says_after_it_moved() -> None:
    bench = Bench().zeroed()
    torque = np.array([0.4, 0.2])
    with bench.arm as arm:
        arm.enable()
        for _ in range(100):
            arm.exchange(torque)
            sample = arm.exchange(None)
            close(sample.position, bench.true())
        assert np.abs(bench.true() - HOME).max() > 0.01
        arm.stop(StopKind.QUICK_STOP)
    bench.settle(2000)
    close(bench.sees(), bench.true())


def test_the_drives_own_limits_follow_the_zero() -> None:
    unlimited, told = config_at(), config_at().model_dump(mode="json")
    told["joints"]["turn"]["position"] = (-1.0, 1.0)
    bench = Bench(ArmConfig.model_validate(told))
    bench.zeroed().sees()
    zeros = Zeros(unlimited)
    gears = np.diag(GEARS["ratios"]) @ np.array(GEARS["coupling"]) * 65536 / (2.0 * np.pi)
    at_home = [bench.objects(k).number(ZERO_COUNTS.index, ZERO_COUNTS.sub) for k in range(2)]
    corners = np.array([(a, b) for a in (-1.05, 1.05) for b in (0.05, 1.05)])
    for k in range(2):
        counts = (at_home[k] + 2**31) % 2**32 - 2**31
        assert zeros.mark(k, counts) == bench.marks()[k]
        ends = counts + (corners - HOME) @ gears[k]
        held = [bench.objects(k).number(0x607D, sub) for sub in (1, 2)]
        np.testing.assert_allclose(held, [ends.min(), ends.max()], atol=1.0)


@pytest.mark.parametrize(
    "other",
    [
        config_at((0.5, 0.41)),
        config_at(gears=GEARS | {"ratios": [3.0, -2.0001]}),
        config_at(gears=GEARS | {"coupling": [[1.0, -0.5], [1.0, 0.6]]}),
        config_at(
            drives=[
                {"node": n, "counts": 65535, "rated_torque": 1.0, "max_torque": 5.0, "max_speed": 6000.0}
                for n in (1, 2)
            ]
        ),
    ],
    ids=["home", "ratio", "coupling", "counts"],
)
def test_a_zero_is_void_for_another_description(other: ArmConfig) -> None:
    bench = Bench().zeroed()
    with pytest.raises(PositionUnknown, match="do not know where"):
        bench.another(other).open()
    close(bench.sees(), HOME)  # and stands for the one that it was made with


def test_what_another_host_keeps_in_1020h_is_no_zero() -> None:
    bench = Bench()
    for k in range(2):
        bench.objects(k).put(0x1020, 12345, 1)
        bench.objects(k).put(0x1020, 67890, 2)
    with pytest.raises(PositionUnknown):
        bench.arm.open()


@pytest.mark.parametrize("far", [2**31 - 40_000, -(2**31) + 40_000])
def test_a_count_that_comes_round_its_32_bits_is_followed(far: int) -> None:
    """Powered long ago: the count is near its end, and passes it between two sessions. Limits cannot be told then."""
    told = config_at().model_dump(mode="json")
    for joint in told["joints"].values():
        joint["position"] = None
    bench = Bench(ArmConfig.model_validate(told))
    for motor in bench.behind.emulator.body.motors:
        motor.defects.shift = far
    bench.zeroed()
    for position in ((1.5, 0.4), (-0.9, 0.2), HOME):
        bench.lead(position)
        close(bench.looks(), np.array(position))
        close(bench.sees(), np.array(position))
    told["joints"]["turn"]["position"] = told["joints"]["slide"]["position"] = (-3.0, 3.0)
    limited = bench.another(ArmConfig.model_validate(told))
    with pytest.raises(DriverError, match="do not fit the 32 bits of 607Dh"):
        limited.open()


def test_absolute_drives_keep_their_1020h_for_others() -> None:
    bench = Bench(config_at(zero="absolute"))
    for sub, value in ((1, 12345), (2, 67890)):
        bench.objects(0).put(0x1020, value, sub)
    with pytest.raises(DriverError, match="absolute"):
        bench.arm.zero()
    with bench.arm as arm:
        arm.enable()
    bench.looks()
    asked = [frame.data for tap in bench.taps for frame in tap.sent if frame.identifier == SDO_REQUEST + 1]
    assert asked
    assert not any(data[1:3] == b"\x20\x10" for data in asked)


def test_an_arm_is_not_zeroed_while_it_moves_is_powered_or_driven_by_another() -> None:
    bench = Bench().zeroed()
    marks = bench.marks()
    for k in range(2):
        bench.behind.emulator.faces[k].power._to(0x23)  # type: ignore[attr-defined]
    with pytest.raises(DriverError, match=r"must be off.*node 1: switched on"):
        bench.arm.zero()
    for k in range(2):
        bench.behind.emulator.faces[k].power._to(0x40)  # type: ignore[attr-defined]
    taking = bench.arm.zero

    def pushed() -> None:
        """Somebody leads it on between the two looks."""
        receive = Tapped.receive

        def leads(tap: Tapped, deadline: int) -> Frame | None:
            if deadline - tap.clock.now_ns() > 400 * MS:
                bench.lead(HOME + np.array([0.02, 0.0]))
            return receive(tap, deadline)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Tapped, "receive", leads)
            taking()

    with pytest.raises(DriverError, match=r"the arm moves: turn 0.020"):
        pushed()
    bench.lead(HOME)

    def beats(config: ArmConfig) -> list[Tapped]:
        (tap,) = bench._links(config)
        tap.disturb([Frame(0x77F, b"\x05")], drives_hear=False)
        return [tap]

    with pytest.raises(DriverError, match="another host"):
        CanopenArm(bench.config, beats).zero()
    with bench.arm as arm, pytest.raises(DriverError, match="open"):
        arm.zero()
    assert bench.marks() == marks
    close(bench.sees(), HOME)


def test_drives_without_1020h_or_that_store_it_are_refused() -> None:
    head, _, rest = EDS.partition("[1020]")
    without = head.replace("SupportedObjects=65", "SupportedObjects=64") + "[1029]" + rest.partition("[1029]")[2]
    numbered = [line for line in without.split("\n") if not line.endswith("=0x1020")]
    bare = config_at(eds={"name": "bare.eds", "text": "\n".join(numbered)})
    arm = CanopenArm(bare, lambda _: [LockStepArm(bare).link(0)])
    with pytest.raises(DriverError, match=r"node 1: has no object 1020h.*zero: absolute"):
        arm.zero()
    storing = config_at(
        eds={
            "name": "storing.eds",
            "text": EDS.replace(
                "[1020]",
                "[1010]\nParameterName=Store\nObjectType=0x8\nSubNumber=2\n\n[1010sub0]\nParameterName=Highest\n"
                "ObjectType=0x7\nDataType=0x0005\nAccessType=const\nDefaultValue=1\nPDOMapping=0\n\n[1010sub1]\n"
                "ParameterName=All\nObjectType=0x7\nDataType=0x0007\nAccessType=rw\nDefaultValue=2\nPDOMapping=0\n\n"
                "[1020]",
            ).replace("1=0x1003\n", "1=0x1003\n66=0x1010\n"),
        }
    )
    with pytest.raises(DriverError, match=r"node 1: stores parameters by itself"):
        CanopenArm(storing, lambda _: [LockStepArm(storing).link(0)]).zero()


@pytest.mark.parametrize("lost", range(1, 11))
def test_one_drive_that_cannot_be_zeroed_leaves_none_zeroed(lost: int) -> None:
    """From its n-th request for 1020h on, the second drive does not hear us any more, for a while.

    The first two ask whether it has that object; then three values are written, each read back, and two read at last.
    """
    bench = Bench().zeroed()
    before = bench.marks()
    bench.lead((0.1, 0.3))
    bench.loses = deaf_from(lost)
    words = "" if lost <= 2 else r".*no drive has a zero now; drives 2 could not be cleared"
    with pytest.raises(DriverError, match=rf"node 2: (setting|reading) 1020h{words}"):
        bench.arm.zero()
    bench.loses = lambda frame: False
    if lost <= 2:
        assert bench.marks() == before
        return
    assert bench.marks()[0] == 0
    with pytest.raises(PositionUnknown):
        bench.arm.open()


def deaf_from(count: int) -> Any:
    seen: list[Frame] = []

    def loses(frame: Frame) -> bool:
        if frame.identifier == SDO_REQUEST + 2 and frame.data[1:3] == b"\x20\x10":
            seen.append(frame)
        return frame.identifier == SDO_REQUEST + 2 and count <= len(seen)

    return loses


def test_a_drive_that_restarts_in_a_session_has_lost_its_zero_when_it_ends() -> None:
    bench = Bench().zeroed()
    with bench.arm as arm:
        arm.enable()
        arm.exchange(np.zeros(2))
        bench.behind.inject(DriveFault("reboot", 1))
        for _ in range(50):
            arm.exchange(np.zeros(2))
    assert bench.marks()[1] == 0
    with pytest.raises(PositionUnknown, match="drives 2 do not know"):
        bench.arm.open()


@pytest.mark.parametrize("powered_at", [(-0.3, 0.9), HOME], ids=["elsewhere", "at home"])
@pytest.mark.parametrize("request_number", [1, 5, 20, 40, *range(60, 77)])  # opening asks it 76 times
def test_a_drive_that_restarts_while_the_arm_is_opened_is_not_vouched_for(
    request_number: int, powered_at: Sequence[float]
) -> None:
    bench = Bench(powered_at=powered_at).zeroed()
    vouched = bench.marks()[1]
    bench.lead((0.1, 0.3))
    asked: list[Frame] = []

    def strikes(frame: Frame) -> bool:
        if frame.identifier == SDO_REQUEST + 2:
            asked.append(frame)
            if len(asked) == request_number:
                bench.behind.inject(DriveFault("reboot", 1))
        return False

    bench.loses = strikes
    with pytest.raises(DriverError):
        bench.arm.open()
    assert len(asked) >= request_number
    assert bench.marks()[1] != vouched
    bench.loses = lambda frame: False
    bench.settle(100)
    with pytest.raises(PositionUnknown, match="drives 2 do not know"):
        bench.arm.open()


def test_a_look_ends_when_a_drive_restarts() -> None:
    bench = Bench().zeroed()
    with bench.arm.look() as arm:
        arm.exchange(None)
        bench.behind.inject(DriveFault("reboot", 0))
        bench.settle(100)
        with pytest.raises(PositionUnknown, match="drives 1 do not know"):
            arm.exchange(None)


def test_a_latched_fault_is_reported_and_does_not_keep_it_from_being_zeroed() -> None:
    bench = Bench()
    bench.behind.inject(DriveFault("emergency", 1, size=0x4310))
    bench.settle(100)
    bench.lead(HOME)
    first, second = bench.arm.zero()
    assert first == "node 1: switch on disabled"
    assert second.startswith("node 2: fault (4310h")
    close(bench.looks(), HOME)


def test_a_preflight_ticket_is_for_one_zero() -> None:
    bench = Bench().zeroed()
    with bench.arm as arm:
        first = arm.describe().identities
    bench.lead(HOME + 0.01)
    bench.arm.zero()
    with bench.arm as arm:
        assert arm.describe().identities != first
