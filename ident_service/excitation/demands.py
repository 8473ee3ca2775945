"""Bound, for all time, the position, velocity, torque and power of a motion, and compare them with the limits.

Every number here holds between samples too: position, velocity, acceleration and jerk come from enclosures of the
path over short stretches of time, torque and power from the model's formulas run on those enclosures (`taylor.py`),
dry friction either way wherever the direction is not certain. Torque is that of the model in use; what the
model does not know is for a margin to cover.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident_service.config.limits import MotionLimits, motor_limits
from ident_service.config.workspace import Supply
from ident_service.errors import MotionRefused
from ident_service.excitation.enclosure import Stretches, stretches
from ident_service.excitation.path import Path
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.chain import Array
from ident_service.model.regressor import traced_regressor
from ident_service.model.tape import Value
from ident_service.model.taylor import Taylor, enclose

_KINDS = ("velocity", "acceleration", "jerk", "torque")


@dataclass(frozen=True)
class Demands:
    """Peak bounds over a whole motion, each of shape (joints,) unless said otherwise.

    Attributes:
        lowest: position [rad or m].
        highest: position [rad or m].
        velocity: largest size.
        acceleration: largest size.
        jerk: largest size.
        torque: largest size, or None where no model is known.
        power: the most that the supply gives [W], or None where nothing is known of it.
        motors: torque of motors that share joints, largest size [N m], None where there are none or no model is known.
        when: by name of the above, the times [s] near which the bounds are reached; one number for power.
        slack: by name, the most by which a bound exceeds the largest sample; one number for power.
    """

    lowest: Array
    highest: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array | None
    power: float | None
    when: dict[str, Array]
    slack: dict[str, Array]
    motors: Array | None = None

    def violations(self, names: tuple[str, ...], limits: MotionLimits, supply: Supply | None = None) -> list[str]:
        """Return every limit that a bound exceeds, in words; empty when the arm may move so."""
        # Negated comparisons, so that a bound that is NaN counts as beyond every limit.
        found = []
        for k, name in enumerate(names):
            if not (self.lowest[k] >= limits.lower[k] and self.highest[k] <= limits.upper[k]):
                found.append(
                    f"{name}: position {self.lowest[k]:.3f}..{self.highest[k]:.3f} "
                    f"leaves {limits.lower[k]:g}..{limits.upper[k]:g}"
                )
            for key in _KINDS[:-1]:
                peak, limit = getattr(self, key), getattr(limits, key)
                if not peak[k] <= limit[k]:
                    found.append(f"{name}: {key} {peak[k]:.3f} exceeds {limit[k]:g}")
        return found + self.forces_beyond(names, limits, supply)

    def forces_beyond(self, names: tuple[str, ...], limits: MotionLimits, supply: Supply | None = None) -> list[str]:
        """Return the violations of torque and power alone, in words."""
        found = []
        if self.torque is not None:
            rows = zip(names, self.torque, limits.torque, strict=True)
            found += [f"{name}: torque {peak:.3f} exceeds {limit:g}" for name, peak, limit in rows if not peak <= limit]
        if self.motors is not None and limits.motors is not None:
            rows = zip(limits.motors.names, self.motors, limits.motors.torque, strict=True)
            found += [f"{name}: torque {peak:.3f} exceeds {most:g}" for name, peak, most in rows if not peak <= most]
        if self.power is not None and supply is not None and not self.power <= supply.budget:
            found.append(f"supply: {self.power:.1f} W exceeds {supply.budget:g} W")
        return found


def demands(path: Path, model: ArmModel) -> Demands:
    """Return the peak bounds of a motion, over all time.

    Args:
        path: the motion.
        model: its prior parameters give the torque.
    """
    cells = stretches(path)
    position = cells.of(0)
    bounds: dict[str, Array] = {
        "lowest": np.array([-value.lowest.min() for value in position]),
        "highest": np.array([value.highest.max() for value in position]),
    }
    when = {
        "lowest": np.array([cells.time[value.lowest.argmin()] for value in position]),
        "highest": np.array([cells.time[value.highest.argmax()] for value in position]),
    }
    slack = {
        "lowest": bounds["lowest"] + cells.values[0].min(axis=0),
        "highest": bounds["highest"] - cells.values[0].max(axis=0),
    }
    enclosed = {kind: cells.of(order) for order, kind in enumerate(("velocity", "acceleration", "jerk"), start=1)}
    prior = control_model(model).prior
    if prior is not None:
        enclosed["torque"] = torque_enclosures(cells, model, prior)
    for kind, values in enclosed.items():
        sizes = np.array([value.size for value in values])
        bounds[kind] = sizes.max(axis=1)
        when[kind] = cells.time[sizes.argmax(axis=1)]
        slack[kind] = bounds[kind] - np.abs([value.c for value in values]).max(axis=1)
    shared = motor_limits(model.config)
    motors: Array | None = None
    if shared is not None and "torque" in enclosed:
        motors = np.array([effort.size.max() for effort in _drive_rates(enclosed["torque"], shared.to_motors)])
    power: float | None = None
    if model.config.supply is not None and "torque" in enclosed:
        drawn = power_bounds(enclosed["torque"], enclosed["velocity"], model.config.supply, model.chain.coupling)
        power = float(drawn.max())
        when["power"] = cells.time[drawn.argmax()]
    return Demands(
        lowest=-bounds["lowest"],
        highest=bounds["highest"],
        velocity=bounds["velocity"],
        acceleration=bounds["acceleration"],
        jerk=bounds["jerk"],
        torque=bounds.get("torque"),
        power=power,
        when=when,
        slack=slack,
        motors=motors,
    )


def torque_enclosures(cells: Stretches, model: ArmModel, delta: Array) -> list[Taylor]:
    """Return enclosures of every joint's torque with link parameters `delta`, shape (layout.size,), per stretch."""
    tape, entries = traced_regressor(model.chain, model.layout)
    n = model.chain.joints
    torque: list[Value] = [0.0] * n
    for (joint, column), entry in entries.items():
        if (factor := float(delta[column])) != 0.0:
            torque[joint] = torque[joint] + entry * factor
    velocity = cells.of(1)
    direction = [rate.function("sign") for rate in _drive_rates(velocity, model.chain.coupling)]
    return enclose(tape, [*cells.of(0), *velocity, *cells.of(2), *direction], torque)


def _drive_rates(velocity: list[Taylor], coupling: Array) -> list[Taylor]:
    rates = []
    for share in coupling:
        terms = [value.scaled(float(factor)) for value, factor in zip(velocity, share, strict=True) if factor]
        rate = terms[0]
        for term in terms[1:]:
            rate = rate + term
        rates.append(rate)
    return rates


def power_bounds(torque: list[Taylor], velocity: list[Taylor], supply: Supply, coupling: Array) -> Array:
    """Return the most power that is drawn from the supply [W], shape (stretches,), as `Supply` counts it.

    Torque and velocity of the joints are handed to the drives that move them, `tau_drive = C^-T tau`.
    """
    rates = _drive_rates(velocity, coupling)
    efforts = _drive_rates(torque, np.asarray(np.linalg.inv(coupling).T, dtype=np.float64))
    loss = np.broadcast_to(np.asarray(supply.loss, dtype=float), (len(rates),))
    total = np.full_like(velocity[0].c, supply.standby)
    for effort, rate, heat in zip(efforts, rates, loss, strict=True):
        total += np.maximum((effort * rate + (effort * effort).scaled(float(heat))).highest, 0.0)
    return total


def require_within_limits(path: Path, model: ArmModel, limits: MotionLimits) -> Demands:
    """Return the motion's peak bounds, and refuse a motion that exceeds the limits.

    Raises:
        MotionRefused: it asks for more than the arm may do; every violation is named.
    """
    asked = demands(path, model)
    if found := asked.violations(model.chain.names, limits, model.config.supply):
        raise MotionRefused("the motion leaves the arm's limits: " + "; ".join(found))
    return asked
