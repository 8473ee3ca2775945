"""Convert to the integers of CANopen drives: counts of 32 bits, thousandths of a rated torque."""

from __future__ import annotations

from drivers.motor_units import Coordinates, Vector, motor_coordinates
from ident_service.config.canopen import CanopenDriver
from ident_service.config.recording import Transmission
from ident_service.errors import DriverError

MOST_COUNTS = 32_767  # of a torque, either way: -32768 has no opposite
_TURN = 1 << 32  # counts after which a position of 32 bits comes round
_PER_MILLE = 1000.0


def coordinates(driver: CanopenDriver, transmission: Transmission) -> Coordinates:
    """Return the coordinates of an arm as described, with counts of 0 where the transmission has its zero.

    Args:
        driver: the section `driver`.
        transmission: the section `transmission`, whose motors are the driver's drives in their order.

    Raises:
        DriverError: not as many drives as ratios.
    """
    drives = driver.drives
    return motor_coordinates(
        transmission,
        [drive.counts for drive in drives],
        [drive.rated_torque * drive.torque_scale / _PER_MILLE for drive in drives],
        [torque_limit_counts(drive.max_torque, drive.rated_torque) for drive in drives],
    )


def count_limits(coordinates: Coordinates, lowest: Vector, highest: Vector) -> list[tuple[int, int] | None]:
    """Return each motor's lowest and highest counts (607Dh) for joint limits, None without; DriverError beyond 32 bits.

    Raises:
        DriverError: counts that 32 bits do not hold.
    """
    limits = coordinates.count_limits(lowest, highest)
    for low, high in filter(None, limits):
        if not -_TURN // 2 <= low <= high < _TURN // 2:
            raise DriverError(
                f"position limits at counts {low} to {high} do not fit the 32 bits of 607Dh; "
                "a drive that counts from power-up starts again when its power is switched"
            )
    return limits


def torque_limit_counts(max_torque: float, rated_torque: float) -> int:
    """Return a motor's largest torque as thousandths of its rated torque, rounded down; at most what 6071h holds."""
    # 1.8/0.2 is a little below 9 in floating point.
    return min(int(_PER_MILLE * max_torque / rated_torque + 1e-6), MOST_COUNTS)


def signed(value: int) -> int:
    """Convert an unsigned number of 32 bits to the signed one with the same bits."""
    return (value + _TURN // 2) % _TURN - _TURN // 2
