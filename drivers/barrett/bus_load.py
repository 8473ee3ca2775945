"""Work out what the frames of an arm of pucks cost on their bus, and whether they fit (`drivers/can/bus_load.py`).

A cycle has the request for positions, as many positions as there are pucks, and one or two frames of torques; beside it
MODE is asked for once a status period, the safety puck's twice, and what the pendant shows. Typical values are
positions within ten motor turns of zero, torques of up to 500 counts.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from functools import lru_cache

from drivers.barrett.protocol import (
    Group,
    Mode,
    Pendant,
    Properties,
    Role,
    SafetyMode,
    get,
    pendant_value,
    position_frame,
    reply,
    torque_frame,
)
from drivers.can.bus_load import ROUND_RATES, Budget, BusLoad, Line, line_of, mean_bits, shares
from ident_service.config.barrett import BarrettDriver

_NEWEST = Properties(0x7FFF, Role.MOTOR)
_SAFETY = Properties(0x7FFF, Role.SAFETY)
_COUNTS, _TORQUE = 40_000, 500


def budget(driver: BarrettDriver, rate: float) -> Budget:
    """Compute the bus load of an arm's frames at a rate.

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
        yield f"run at {slower} Hz (control.rate): {shares(_budget(driver, float(slower)).buses[0])}"


def _lines(driver: BarrettDriver, rate: float) -> Iterator[Line]:
    bus, often = driver.bus, 1.0 / driver.status_period
    request = get(Group.ARM, _NEWEST.number("P"), group=True).identifier
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
        asked = tuple(get(node, 0).identifier for node in nodes)
        answers = tuple(reply(node, 0, 0, wide=False).identifier for node in nodes)
        yield line_of(f"asks {whose}", asked, 1, times * often, bus, _of_question)
        yield line_of("answers", answers, 4, times * often, bus, _of_answer)
    yield line_of("asks for the pendant", asked, 1, often, bus, _of_question)
    yield line_of("answer", answers, 6, often, bus, _of_pendant)


@lru_cache(maxsize=64)
def _of_request(identifier: int) -> tuple[float, float]:
    return mean_bits(identifier, lambda draw: get(0, _NEWEST.number("P")).data)


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
    return mean_bits(identifier, lambda draw: get(0, _NEWEST.number("MODE")).data)


@lru_cache(maxsize=64)
def _of_answer(identifier: int) -> tuple[float, float]:
    modes = (Mode.TORQUE, SafetyMode.ACTIVE)
    return mean_bits(identifier, lambda draw: reply(0, _NEWEST.number("MODE"), draw.choice(modes), wide=False).data)


@lru_cache(maxsize=64)
def _of_pendant(identifier: int) -> tuple[float, float]:
    shown = pendant_value(Pendant(activate_light=True, digit="0"))
    return mean_bits(identifier, lambda draw: reply(0, _SAFETY.number("PEN"), shown, wide=True).data)


def _counts(draw: random.Random) -> int:
    return draw.randint(-_COUNTS, _COUNTS)
