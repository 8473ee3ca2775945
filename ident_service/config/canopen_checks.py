"""Check a description's CANopen drives against its joints, gears, rate and the drives' data sheets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ident_service.config.canopen import CanopenDriver, motor_speeds
from ident_service.config.eds import data_sheet
from ident_service.config.recording import Transmission
from ident_service.config.watchdogs import ABORTING
from ident_service.errors import DriverError

_ASKED = 0.7  # of the guard time, after which a drive is asked again; all must be asked within it
_WHOLE_TURNS = 0.999  # 6080h holds whole turns per minute
_LEAST_DEADLINE = 2.0  # cycles: one frame may be late
# Without positions, as long as a stall of this computer may last (decision 0069), or FIELDBUS.md's cycles.
_LONGEST_LOSS, _MOST_LOST = 0.010, 5  # s; cycles


def disagreements(
    driver: CanopenDriver,
    transmission: Transmission | None,
    joints: Sequence[str],
    rate: float,
    homeless: Sequence[str] = (),
    velocities: Sequence[float | None] = (),
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield what is inconsistent with an arm of these joints: the place in the file, and the mistake.

    Args:
        driver: the section `driver`.
        transmission: the arm's.
        joints: names of the arm's joints; none where the file does not name them.
        rate: cycles per second.
        homeless: those without a `home`.
        velocities: of the joints [rad/s or m/s], None where one has no limit; none where the file names no joints.
    """
    if driver.zero == "at_home" and homeless:
        yield (
            ("driver", "zero"),
            "driver.zero: at_home needs every joint's home, the posture in which a person zeroes the arm; missing: "
            + ", ".join(f"joints.{name}.home" for name in homeless),
        )
    if driver.reactions.abort_connection == 0 and any(drive.watchdog in ABORTING for drive in driver.drives):
        yield (
            ("driver", "reactions"),
            "driver.reactions.abort_connection: 0 has drives do nothing when the host is gone (6007h); take what the"
            " drive's manual calls a quick stop or a fault",
        )
    guarded = sum(drive.watchdog == "node_guarding" for drive in driver.drives)
    if guarded / rate > _ASKED * driver.guarding.period:
        yield (
            ("driver", "guarding"),
            f"driver.guarding.period: {driver.guarding.period:g} s is too short to ask {guarded} drives, one a cycle"
            f" at {rate:g} Hz; at least {guarded / rate / _ASKED:.3g} s",
        )
    if guarded and any(b.data_bitrate for b in driver.buses):
        yield ("driver", "buses"), "driver.buses: CAN FD has no remote frames, which node guarding asks with"
    if driver.torque_deadline * rate < _LEAST_DEADLINE:
        yield (
            ("driver", "torque_deadline"),
            f"driver.torque_deadline: {driver.torque_deadline:g} s at {rate:g} Hz has no room for a late torque frame;"
            f" at least {_LEAST_DEADLINE:g} cycles are needed, {_LEAST_DEADLINE / rate:g} s",
        )
    if driver.lost_cycles > max(_MOST_LOST, _LONGEST_LOSS * rate):
        yield (
            ("driver", "lost_cycles"),
            f"driver.lost_cycles: {driver.lost_cycles} at {rate:g} Hz is {1e3 * driver.lost_cycles / rate:g} ms without"
            f" positions; at most {max(_MOST_LOST, int(_LONGEST_LOSS * rate))} cycles",
        )
    if transmission is None:
        yield ("driver",), "CANopen drives need the section transmission: gear ratios from joints to motors"
    elif len(transmission.ratios) != len(driver.drives):
        yield ("driver", "drives"), f"{len(driver.drives)} drives but {len(transmission.ratios)} ratios in transmission"
    elif len(velocities) == len(driver.drives):
        for k, (drive, speed) in enumerate(zip(driver.drives, motor_speeds(transmission, velocities), strict=True)):
            if drive.max_speed < _WHOLE_TURNS * speed:
                yield (
                    ("driver", "drives", k),
                    f"driver.drives: node {drive.node} would give no torque above max_speed {drive.max_speed:g} turns"
                    f" per minute (6080h), but its motor turns at {speed:.0f} when joints move at their limits:"
                    " raise max_speed, or lower joints.NAME.velocity",
                )
    shares = driver.torque_frames == "shared" and any(
        sum(drive.bus == bus for drive in driver.drives) > 1 for bus in range(len(driver.buses))
    )
    if why := data_sheet(driver.eds.text).mistake:
        yield ("driver", "eds"), f"driver.eds: {driver.eds.name} is not an EDS (CiA 306): {why}; take the drive maker's"
    elif shares and not driver.shares_by_sheet:
        yield (
            ("driver", "eds"),
            f"driver.eds: {driver.eds.name} has no Dummy0003=1 under [DummyUsage], nor another dummy of 8 or 16"
            " bits, so that these drives cannot share torque frames; set driver.torque_frames to single, at a rate"
            " that it fits",
        )
    elif driver.measured_torque in ("cyclic", "status") and not all(sheet.has(0x6077) for sheet in driver.sheets):
        yield (
            ("driver", "measured_torque"),
            f"driver.measured_torque: {driver.eds.name} has no 6077h, so that these drives do not tell their torque",
        )
    try:
        driver.families  # noqa: B018 - reading them checks them
    except DriverError as error:
        yield ("driver", "profiles"), f"driver.profiles: {error}"
    if joints and len(joints) != len(driver.drives):
        yield ("driver", "drives"), f"{len(driver.drives)} drives for {len(joints)} joints"
