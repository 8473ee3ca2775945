"""Arms of emulated pucks on a lock-step bus to break, and what is promised of every fault that pucks can have.

Beside the pucks' faults there are those of the host's side of the wire (`WIRE`): torque frames that get lost, and
another host that sends what only ours may. What a puck says of itself is asked for every 50 ms, so that an axis that
lost its torque may be missed by its motion first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from campaign_bench import READ_WRONGLY, UNTRUE, Promise, Strike, Subject, wam_config
from helpers.emulated_arms import Tapped
from motion_bench import JOINTS, TRUTH, WatchedArm, bench_config

from drivers.arm import Sample
from drivers.barrett.driver import BarrettArm
from drivers.barrett.protocol import get_frame, set_frame, torque_frame
from drivers.can.can_frame import Frame
from ident_service.config.arm import ArmConfig
from ident_service.config.motion_limits import motion_limits
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from sim_backend.emulator.faults import DRIVE_FAULTS, DriveFault
from sim_backend.emulator.lock_step import LockStepArm
from sim_backend.machine import Truth

PERIOD = 1e-3
FOREIGN: dict[str, Frame] = {
    "foreign_request": get_frame(4, 48, group=True),
    "foreign_torque": torque_frame(1, 42, (0, 0, 0, 0)),
    "foreign_mode": set_frame(10, 8, 1),
}
WIRE = ("lost_torques", *FOREIGN, "full_queue")
SOON, STATUS = 3, 70  # cycles: on the bus; until everybody was asked, and the pendant why
LOST = 3
# The safety puck stops an arm that is too fast, or seems so, by itself.
_LIES, _MISREAD = UNTRUE | {"drive_emergency", "drive_fault"}, READ_WRONGLY | {"drive_emergency", "drive_fault"}
_GONE = UNTRUE | {"drive_left", "drive_fault"}

PUCK_PROMISES: dict[str, Promise] = {
    "lost_feedback": Promise({"feedback_gone"}, duration=50, within=LOST + 2),
    "delayed_feedback": Promise({"feedback_gone"}, size=0.005, within=LOST + 2),
    "hidden_delay": Promise(_MISREAD, size=0.02),
    "encoder_jump": Promise({"encoder_jumps"}, size=0.5, duration=2, within=SOON),
    "encoder_offset": Promise({"feedback_gone"}, size=0.5, within=LOST + 2),
    "frozen_encoder": Promise(_LIES, duration=10**6),
    "position_sign": Promise(_MISREAD),
    "stuck_torque": Promise(_LIES, duration=10**6),
    "torque_sign": Promise(_LIES),
    "torque_saturation": Promise(_LIES, size=0.05),
    "torque_fraction": Promise(_LIES, size=0.3),
    "drive_fault": Promise(_GONE, within=STATUS),
    "node_silent": Promise({"feedback_gone"}, within=LOST + 2),
    "emergency_stop": Promise(UNTRUE | {"emergency_stop"}, within=STATUS),
    "load_attached": Promise(_LIES, size=2.0),
    "bus_gone": Promise({"driver"}, duration=10**6, within=SOON, words=("gone",)),
    "emergency": Promise(_GONE, size=0x11, within=STATUS),
    "warning": Promise(set(), warns="drive_warning", words=("the pendant shows voltage warning",), told_after=STATUS),
    "reboot": Promise({"feedback_gone"}, within=LOST + 2),
    "wrong_node": Promise({"repeated_warnings"}, within=25, words=("second position", "after its cycle")),
    "short_frame": Promise({"feedback_gone"}, duration=50, within=LOST + 2),
    "bus_off": Promise({"bus_off"}, within=SOON, words=("bus-off",)),
    "error_passive": Promise({"bus_degraded"}, within=SOON, words=("passive",)),
    "lost_torques": Promise(_LIES, duration=10**6),
    **{kind: Promise({"second_host"}, within=SOON, words=("somebody else",)) for kind in FOREIGN},
    "full_queue": Promise({"driver"}, duration=5, within=SOON, words=("the transmit queue is full",)),
}


class PuckArm(WatchedArm):
    """The driver's arm over emulated pucks, that breaks before one of its exchanges.

    Attributes:
        behind: the pucks.
        taps: on the bus, as opened last.
    """

    def __init__(
        self, config: ArmConfig, strike: Strike | None = None, observer: Callable[[Truth], None] | None = None
    ) -> None:
        self.behind = LockStepArm(config)
        self.behind.emulator.observer = observer
        self.taps: list[Tapped] = []
        self._strike = strike
        super().__init__(BarrettArm(config, self._links))
        self.before_exchange = self._break

    def _links(self, config: ArmConfig) -> list[Tapped]:
        self.taps = [Tapped(self.behind.link(0))]
        return self.taps

    def exchange(self, torque: object) -> Sample:
        if self._strike is not None and self._strike.kind == "lost_torques":
            first, last = self._strike.at_cycle, self._strike.at_cycle + (self._strike.duration or 1)
            lost = first <= self.cycle < last
            self.taps[-1].loses = lambda frame: lost and frame.identifier in (0x401, 0x402)
        return super().exchange(torque)  # type: ignore[arg-type]

    def _break(self, cycle: int) -> None:
        strike = self._strike
        if strike is None or cycle != strike.at_cycle or strike.kind == "lost_torques":
            return
        if strike.kind == "full_queue":
            self.taps[-1].full_until_ns = self.clock.now_ns() + round((strike.duration or 1) * PERIOD * 1e9)
            return
        if strike.kind in FOREIGN:
            self.taps[-1].disturb([FOREIGN[strike.kind]])
            return
        duration = None if strike.duration is None else strike.duration * PERIOD
        self.behind.inject(DriveFault(strike.kind, strike.joint, strike.later * PERIOD, duration, strike.size))

    def strike(self, fault: Strike) -> None:
        self._strike = fault

    def left_alone(self) -> None:
        """Longer than the safety puck waits for positions."""
        self.behind.settle(self.clock.now_ns() + 150_000_000)


def bench_puck_config() -> ArmConfig:
    """The bench's arm behind two pucks with gears of 1, whose counts are fine enough for its gains."""
    puck = {"cts": 1 << 18, "ipnm": 256}
    return bench_config(
        joints=JOINTS,
        transmission={"ratios": [1.0, 1.0], "drive_terms": "joints"},
        driver={
            "kind": "barrett",
            "bus": {"interface": "lock_step", "channel": "bench"},
            "pucks": [puck | {"node": 1, "mt": 7680}, puck | {"node": 2, "mt": 3840}],
            "limits": {"velocity": 7.9, "torque": 8191},
            "lost_cycles": LOST,
            "emulation": {"truth": TRUTH, "operator": 0.02, "zeroed": True},
        },
    )


def wam_puck_config() -> ArmConfig:
    """The shipped WAM of pucks at 1 kHz, zeroed, with somebody at the pendant."""
    driver = wam_config("wam7_pucks_1khz").model_dump(mode="json", by_alias=True)["driver"]
    driver["bus"] = {"interface": "lock_step", "channel": "wam"}
    driver["limits"]["velocity"] = 4.0
    driver["lost_cycles"] = LOST
    driver["emulation"] |= {"zeroed": True, "operator": 0.02}
    return wam_config("wam7_pucks_1khz", driver=driver)


def of_joint(kind: str) -> bool:
    """Tell if a fault may be one puck's."""
    return kind not in WIRE and kind != "warning" and DRIVE_FAULTS[kind].of_joint


@cache
def puck_subject(name: str) -> Subject:
    """`bench pucks` or `wam pucks`."""
    config, pause = (bench_puck_config(), 900) if name == "bench pucks" else (wam_puck_config(), 2600)
    model = arm_model(config)
    with PuckArm(config) as arm:
        step = arm.describe().torque_resolution
    return Subject(
        config,
        model,
        excitation(model, "identification"),
        motion_limits(config),
        pause,
        pause,
        lambda strike, observer: PuckArm(config, strike, observer),
        PUCK_PROMISES,
        of_joint,
        step,
    )
