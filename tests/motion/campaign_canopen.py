"""Arms of emulated drives on a lock-step bus to break, and what is promised of every fault that drives can have.

Beside the faults of the drives there are those of the host's side of the wire (`WIRE`): torque frames that get lost,
and another host that sends what only ours may. An arm that has been left alone must have let go within its drives'
own deadlines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

from campaign_bench import READ_WRONGLY, UNTRUE, Promise, Strike, Subject, wam_config
from helpers.emulated_arms import EDS, Tapped, tapped
from motion_bench import JOINTS, TRUTH, WatchedArm, bench_config

from drivers.arm import Sample
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from ident_service.config.motion_limits import motion_limits
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.safety_monitor import MAX_AGE
from sim_backend.emulator.faults import DRIVE_FAULTS, DriveFault
from sim_backend.emulator.lock_step import LockStepArm
from sim_backend.machine import Truth

# Sent by somebody else; a torque frame, a control word and an NMT command are those that would do harm.
FOREIGN: dict[str, Frame] = {
    "foreign_sync": Frame(0x080),
    "foreign_torque": Frame(0x201, bytes(4)),
    "foreign_control": Frame(0x301, bytes([0x06, 0x00, 10])),
    "foreign_nmt": Frame(0x000, bytes([0x01, 0x01])),
    "foreign_heartbeat": Frame(0x77F, b"\x05"),
}
QUICK_STOP = bytes([0x02, 0x00])  # control word, before the mode
NOTICE = Frame(0x081, bytes.fromhex("01 ff 00 00 00 00 00 00"))  # without a bit of the error register
WIRE = ("lost_torques", "lost_status", "notice", *FOREIGN, "full_queue")
# Two cycles: a fault may come after the answers of the cycle before which it was handed over.
SOON = 3
# Cycles that are waited for heartbeats, for torque frames, and for status reports.
_TIMEOUT, _DEADLINE, _STATUS = 300, 10, 250
# A drive has limits of its own, of speed and position, at which it gives no torque and says so.
_LIES, _MISREAD = UNTRUE | {"torque_ignored"}, READ_WRONGLY | {"torque_ignored"}

CANOPEN_PROMISES: dict[str, Promise] = {
    "lost_feedback": Promise({"feedback_gone"}, duration=50, within=MAX_AGE + 1),
    "delayed_feedback": Promise({"feedback_gone"}, size=0.005, within=MAX_AGE + 1),
    "hidden_delay": Promise(_MISREAD, size=0.02),
    "encoder_jump": Promise({"encoder_jumps"}, size=0.5, duration=2, within=SOON),
    "encoder_offset": Promise({"feedback_gone"}, size=0.5, within=MAX_AGE + 1),
    "frozen_encoder": Promise(_LIES, duration=10**6),
    "position_sign": Promise(_MISREAD),
    "stuck_torque": Promise(_LIES, duration=10**6),
    "torque_sign": Promise(_LIES),
    "torque_saturation": Promise(_LIES, size=0.05),
    "torque_fraction": Promise(_LIES, size=0.3),
    "drive_fault": Promise({"drive_emergency"}, within=SOON, words=("5400h power section",)),
    "node_silent": Promise({"feedback_gone"}, within=MAX_AGE + 1),
    "emergency_stop": Promise({"drive_emergency"}, within=SOON, words=("3220h under-voltage of the DC link",)),
    "load_attached": Promise(_LIES, size=2.0),
    "bus_gone": Promise({"driver"}, duration=10**6, within=SOON, words=("gone",)),
    "emergency": Promise({"drive_emergency"}, size=0x4310, within=SOON, words=("4310h drive too hot",)),
    "warning": Promise(
        {"repeated_warnings"}, warns="drive_warning", words=("warns",), told_after=55
    ),  # status comes every 50 ms
    "heartbeat_lost": Promise({"drive_silent"}, within=_TIMEOUT + 12, words=("no heartbeat for 0.3 s",)),
    "reboot": Promise({"feedback_gone", "drive_restarted"}, within=MAX_AGE + 1),
    "wrong_node": Promise({"repeated_warnings"}, within=25, words=("second position", "after its cycle")),
    "short_frame": Promise({"feedback_gone"}, duration=50, within=MAX_AGE + 1),
    "bus_off": Promise({"bus_off"}, within=SOON, words=("bus-off",)),
    "error_passive": Promise({"bus_degraded"}, within=SOON, words=("passive",)),
    "lost_torques": Promise({"drive_emergency"}, duration=50, within=_DEADLINE + SOON, words=("8250h RPDO timeout",)),
    "lost_status": Promise(
        {"status_stale"}, duration=10**6, within=_STATUS + 12, words=("no status report for 0.25 s",)
    ),
    "notice": Promise({"drive_notice"}, warns="drive_notice", words=("FF01h",)),
    **{kind: Promise({"second_host"}, within=SOON, words=("another host",)) for kind in FOREIGN},
    "full_queue": Promise({"driver"}, duration=5, within=SOON, words=("the transmit queue is full",)),
}


# Drives that close the loop hold the joints' torque themselves; what they measure beside the model's ends the motion.
POSITION_RATE = 500.0
_SHARE = POSITION_RATE / 1000.0  # of the cycles that a time has
_MEASURED = {"torque_unexplained", "torque_exceeded"}
POSITION_PROMISES: dict[str, Promise] = {
    kind: replace(
        promise,
        codes=promise.codes | (_MEASURED if promise.codes & UNTRUE else set()),
        size=promise.size / _SHARE if kind == "delayed_feedback" else promise.size,  # more cycles than a joint may miss
        within=round(_SHARE * promise.within) if promise.within is not None and promise.within > 50 else promise.within,
    )
    for kind, promise in CANOPEN_PROMISES.items()
}


def is_quick_stop(frame: Frame) -> bool:
    return 0x300 < frame.identifier < 0x380 and frame.data[:2] == QUICK_STOP


class EmulatedArm(WatchedArm):
    """The driver's arm over emulated drives, that breaks before one of its exchanges.

    Attributes:
        behind: the drives.
        taps: on the buses, as opened last.
        states: of the drives, after they have been left alone.
        told_to_brake: drives that had been told to when they were left alone.
    """

    def __init__(
        self, config: ArmConfig, strike: Strike | None = None, observer: Callable[[Truth], None] | None = None
    ) -> None:
        self.behind = LockStepArm(config)
        self.behind.emulator.observer = observer
        self.taps: list[Tapped] = []
        self.states: tuple[str, ...] = ()
        self.told_to_brake = 0
        self._config, self._strike, self._period = config, strike, 1.0 / config.control.rate
        super().__init__(CanopenArm(config, self._links))
        self.before_exchange = self._break

    def _links(self, config: ArmConfig) -> list[Tapped]:
        self.taps = tapped(self.behind, config)
        return self.taps

    def exchange(self, torque: object) -> Sample:
        self._lose()
        return super().exchange(torque)  # type: ignore[arg-type]

    def exchange_position(self, position: Any) -> Sample:
        self._lose()
        return super().exchange_position(position)

    def _lose(self) -> None:
        if self._strike is not None and self._strike.kind in ("lost_torques", "lost_status"):
            first, last = self._strike.at_cycle, self._strike.at_cycle + (self._strike.duration or 1)
            lost = first <= self.cycle < last
            if self._strike.kind == "lost_torques":
                self.taps[-1].loses = lambda frame: lost and 0x200 <= frame.identifier < 0x280
            else:
                for tap in self.taps:
                    tap.misses = lambda frame: lost and 0x280 <= frame.identifier < 0x300

    def _break(self, cycle: int) -> None:
        strike = self._strike
        if strike is None or cycle != strike.at_cycle or strike.kind in ("lost_torques", "lost_status"):
            return
        if strike.kind == "full_queue":
            for tap in self.taps:
                tap.full_until_ns = self.clock.now_ns() + round((strike.duration or 1) * self._period * 1e9)
            return
        if strike.kind == "notice":
            self.taps[0].disturb([NOTICE], drives_hear=False)
            return
        if strike.kind in FOREIGN:
            self.taps[-1].disturb([FOREIGN[strike.kind]])
            return
        duration = None if strike.duration is None else strike.duration * self._period
        self.behind.inject(DriveFault(strike.kind, strike.joint, strike.later * self._period, duration, strike.size))

    def strike(self, fault: Strike) -> None:
        self._strike = fault

    def left_alone(self) -> None:
        """Longer than the drives wait for torque frames, and for a ramp."""
        told = [{frame.identifier for frame in tap.sent if is_quick_stop(frame)} for tap in self.taps]
        self.told_to_brake = sum(len(nodes) for nodes in told)
        self.behind.settle(self.clock.now_ns() + 50_000_000)
        self.states = self.behind.emulator.states


def bench_canopen_config(*, brakes: bool = True, **floor: float) -> ArmConfig:
    """The bench's arm behind two drives with gears of 1; a thousandth is 1 mN m.

    Without brakes it is held after a stop, and drives stay in quick stop; without power they leave windings open.
    """
    loose = {name: joint | {"brake": False} for name, joint in JOINTS.items()}
    drive = {"counts": 1 << 20, "rated_torque": 1.0, "max_speed": 6000.0}
    return bench_config(
        joints=JOINTS if brakes else loose,
        control={} if brakes else {"after_stop": "hold"} | floor,
        transmission={"ratios": [1.0, 1.0], "drive_terms": "joints"},
        driver={
            "kind": "canopen",
            "eds": {"name": "emulated_drive.eds", "text": EDS},
            "buses": [{"interface": "lock_step", "channel": "bench"}],
            "drives": [drive | {"node": 1, "max_torque": 30.0}, drive | {"node": 2, "max_torque": 15.0}],
            "emulation": {"truth": TRUTH},
        },
    )


def bench_positions_config() -> ArmConfig:
    """The bench's arm behind two drives that close the position loop."""
    document = bench_canopen_config().model_dump(mode="json", by_alias=True)
    document["control"] |= {"rate": POSITION_RATE}
    document["driver"]["streams"] = "position"
    return ArmConfig.model_validate(document)


def wam_canopen_config(buses: int = 1) -> ArmConfig:
    """The shipped WAM of drives, with its differentials; on two buses the wrist has its own."""
    shipped = wam_config("wam7_canopen")
    driver = shipped.model_dump(mode="json", by_alias=True)["driver"]
    driver["buses"] = [{"interface": "lock_step", "channel": f"can{number}"} for number in range(buses)]
    for drive in driver["drives"][4:]:
        drive["bus"] = buses - 1
    return wam_config("wam7_canopen", driver=driver)


def of_joint(kind: str) -> bool:
    """Tell if a fault may be one drive's."""
    return kind not in WIRE and DRIVE_FAULTS[kind].of_joint


@cache
def canopen_subject(name: str) -> Subject:
    """Return one by its name.

    `bench canopen`, `loose canopen`, which has no brakes, `floored canopen` above a floor that ends its sinking,
    `wam canopen`, `wam two buses`, or `bench positions`.
    """
    if name in ("bench canopen", "loose canopen", "floored canopen"):
        floor = {"floor": -0.1} if name == "floored canopen" else {}
        config, pause = bench_canopen_config(brakes=name == "bench canopen", **floor), 900
    elif name == "bench positions":
        config, pause = bench_positions_config(), 450
    else:
        config, pause = wam_canopen_config(2 if name == "wam two buses" else 1), 2600
    model = arm_model(config)
    with EmulatedArm(config) as arm:
        step = arm.describe().torque_resolution
    return Subject(
        config,
        model,
        excitation(model, "identification"),
        motion_limits(config),
        pause,
        pause,
        lambda strike, observer: EmulatedArm(config, strike, observer),
        POSITION_PROMISES if name == "bench positions" else CANOPEN_PROMISES,
        of_joint,
        step,
    )
