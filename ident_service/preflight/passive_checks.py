"""Check an arm without torque: identities of the drives, rest, regular cycles, and noise of positions.

Only `exchange(None)` is used; no drive is energised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.arm import Arm, ArmDescription, Sample, SetupCheck, Vector
from drivers.axis_status import AxisStatus
from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import AnotherDrive, ArmError, PositionUnknown, UnsuitableDrive
from ident_service.model.arm_model import ArmModel
from ident_service.motion.last_position import LOOK_AT_IT, LastPosition, whole_turns_text
from ident_service.motion.ticket import (
    Check,
    Verdict,
    check_from_measures,
    failed_check,
    joint_units,
    measure,
    measures,
    skipped_check,
)
from ident_service.preflight.session import ANSWERS_REMEDY, RATE_REMEDY, UNREACHABLE_REMEDY
from ident_service.preflight.stability import delay_of
from ident_service.preflight.static_checks import LONG_SILENCE_REMEDY, long_silence_text

DRIFT = 0.05  # of the velocity limit, as at the beginning of a run
LATE = 0.25  # of a period: a later cycle counts as late (FIELDBUS.md 5.2, after OWD)
LATE_SHARE = 0.05  # of the cycles may be late (FIELDBUS.md 5.2)
LONGEST_GAP = 20.0  # periods in which the arm is not supervised (FIELDBUS.md 5.2: whole bus silent)
PERIOD_ERROR = 0.02  # of a period: what the median may differ by
STEPS_OF_NOISE = 3.0  # encoder steps: an axis at rest stays on one, or between two
VELOCITY_NOISE = 0.1  # of the velocity limit, peak: the guard stops at 1.2
TORQUE_NOISE = 0.05  # of the torque limit, standard deviation, that the gains make of the noise
LOST = 0.01  # of all answers
STOPPED = {
    AxisStatus.EMERGENCY_STOP: "Release the emergency stop; on a WAM's pendant press Shift-Idle, too.",
    AxisStatus.FAULT: "Read the drive's own fault code and mend its cause; `ident recover ARM` resets it.",
}


@dataclass(frozen=True)
class IdleRecording:
    """Hold cycles recorded without torque.

    Attributes:
        samples: samples, in the order of the cycles.
        woken_ns: time of the loop's clock when each exchange returned [ns], shape (cycles,).
        period: of the description [s].
    """

    samples: tuple[Sample, ...]
    woken_ns: Vector
    period: float

    @property
    def position(self) -> Vector:
        """Return the positions [rad or m], shape (cycles, joints)."""
        return np.array([sample.position for sample in self.samples])

    @property
    def usable(self) -> bool:
        """Return whether every axis has answered with finite positions, in the first, the last and almost all cycles.

        Positions of lost answers repeat the last ones, which is right for an arm at rest.
        """
        valid = np.array([sample.valid for sample in self.samples])
        enough = bool((valid.mean(axis=0) >= 1.0 - LOST).all() and valid[0].all() and valid[-1].all())
        return enough and bool(np.isfinite(self.position).all())


def record_idle(
    arm: Arm, cycles: int, period: float, on_sample: Callable[[Sample], None] = lambda sample: None
) -> IdleRecording:
    """Exchange cycles with an open arm without torque; return their samples and the times of waking.

    Args:
        arm: open.
        cycles: number of cycles.
        period: of its description [s].
        on_sample: function that is called in every cycle, so that the rate is measured under the load of a run.

    Raises:
        DriverError: the arm does not answer at all.
    """
    samples, woken = [], []
    for _ in range(cycles):
        sample = arm.exchange(None)
        woken.append(arm.clock.now_ns())
        samples.append(sample)
        on_sample(sample)
    return IdleRecording(tuple(samples), np.array(woken, dtype=float), period)


def identities_check(
    described: ArmDescription,
    model: ArmModel,
    limits: MotionLimits,
    idle: IdleRecording,
    setup: Sequence[SetupCheck] = (),
) -> Check:
    """Return the check `identities`: joints, drives, answers, torque limits and rate as described, no drive faulted.

    Args:
        described: description by the open arm.
        model: of the arm.
        limits: limits of the description; the driver must not clip below them, or what was proven of torques is not
            true.
        idle: idle recording of the arm.
        setup: reports of the drives on their set-up.
    """
    code, names = "identities", model.chain.names
    if described.joint_names != names:
        return failed_check(
            code,
            f"the drives have the joints {', '.join(described.joint_names)}, the description {', '.join(names)}",
            "Give the description of this arm, or connect the arm that the description means.",
        )
    if wrong := [one for one in setup if not one.good]:
        remedies = dict.fromkeys(one.remedy for one in wrong if one.remedy)
        return failed_check(code, "; ".join(map(str, wrong)), " ".join(remedies))
    if too_long := long_silence_text(model, limits, described.watchdog):
        return failed_check(code, too_long, LONG_SILENCE_REMEDY)
    last = idle.samples[-1]
    stopped: dict[str, list[str]] = {}  # axes, by what their drives tell
    for name, state in zip(names, last.status, strict=False):
        if flags := AxisStatus(state) & (AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP):
            told = " and ".join(flag.name.lower().replace("_", " ") for flag in flags if flag.name)
            stopped.setdefault(told, []).append(name)
    if stopped:
        todo = [remedy for flag, remedy in STOPPED.items() if any(AxisStatus(word) & flag for word in last.status)]
        reason = "; ".join(f"{', '.join(axes)}: {told}" for told, axes in stopped.items())
        return failed_check(code, reason, " ".join(todo))
    answers = np.array([sample.valid & np.isfinite(sample.position) for sample in idle.samples])
    nothing = np.zeros(len(names))
    found = [
        *measures("answers missing", 1.0 - answers.mean(axis=0), ("",) * len(names), names, most=nothing + LOST),
        *measures(
            "torque limit of the driver",
            described.torque_limit,
            joint_units(model.chain.revolute, "N m", "N"),
            names,
            # A driver clips to whole steps of its torque.
            least=limits.torque - described.torque_resolution * 1.001,
        ),
        measure(
            "rate of the driver",
            described.rate,
            "1/s",
            least=0.999 * model.config.control.rate,
            most=1.001 * model.config.control.rate,
        ),
    ]
    if described.delay_cycles > 1:
        what = "cycles from a sample to its torque"
        found.append(measure(what, described.delay_cycles, "", most=delay_of(model.config)))
    # An infinite limit is no finite number, but clips nothing.
    found = [one for one in found if not (one.what.startswith("torque limit") and one.value is None)]
    silent = bool((1.0 - answers.mean(axis=0) > LOST).any())
    agreement = "Bring limits and rate of driver and description into agreement."
    return check_from_measures(code, found, ANSWERS_REMEDY if silent else agreement)


def at_rest_check(
    idle: IdleRecording, model: ArmModel, limits: MotionLimits, last_position: LastPosition | None = None
) -> Check:
    """Return the check `at_rest`: no drift without torque, inside position limits, no motor moved by whole turns.

    Args:
        idle: idle recording of the arm.
        model: of the arm.
        limits: of the arm.
        last_position: last position before the arm was closed, where that is known.
    """
    code, names = "at_rest", model.chain.names
    if not idle.usable:
        return failed_check(
            code, "not every axis answers as it should", "Check bus and encoders of the axes named above."
        )
    position = idle.position
    drift = np.abs(position[-1] - position[0]) / (idle.period * (len(position) - 1))
    speed = joint_units(model.chain.revolute, "rad/s", "m/s")
    angle = joint_units(model.chain.revolute, "rad", "m")
    found = [
        *measures("drift", drift, speed, names, most=DRIFT * limits.velocity),
        *measures("position", position[-1], angle, names, least=limits.lower, most=limits.upper),
    ]
    if last_position is not None:
        found += measures("moved since it was closed last", position[-1] - last_position.position, angle, names)
        if words := whole_turns_text(last_position, position[-1], model.config):
            return failed_check(code, words, LOOK_AT_IT, found)
    return check_from_measures(
        code, found, "Let the arm come to rest on its support, inside its position limits, and keep hands off."
    )


def rate_check(idle: IdleRecording, lock_step: bool) -> Check:
    """Return the check `rate`: median period, worst lateness and share of late cycles; skipped in virtual time.

    Args:
        idle: cycles of the arm, with the work of a run in each.
        lock_step: whether time is virtual.
    """
    code = "rate"
    if lock_step:
        return skipped_check(code, "time is virtual, so there is no lateness to measure")
    period = idle.period
    gaps = np.diff(idle.woken_ns) * 1e-9
    late = np.maximum(gaps - period, 0.0)
    found = [
        measure("median period", float(np.median(gaps)) * 1e3, "ms",
                least=(1.0 - PERIOD_ERROR) * period * 1e3, most=(1.0 + PERIOD_ERROR) * period * 1e3),
        measure("lateness of 99 % of the cycles", float(np.quantile(late, 0.99)) * 1e3, "ms"),
        measure("worst lateness", float(late.max()) * 1e3, "ms", most=LONGEST_GAP * period * 1e3),
        measure("late cycles", float((late > LATE * period).mean()), "", most=LATE_SHARE),
    ]  # fmt: skip
    return check_from_measures(
        code,
        found,
        RATE_REMEDY,
    )


def loop_rate_check(stamps_ns: Vector, period: float, lock_step: bool, idle_check: Check) -> Check:
    """Return the check `rate` with the lateness under torque added; `idle_check` if that failed or time is virtual.

    Args:
        stamps_ns: of the cycles [ns], shape (cycles,).
        period: [s].
        lock_step: whether time is virtual.
        idle_check: the check of the rate without torque.
    """
    if lock_step or idle_check.verdict is not Verdict.PASSED:
        return idle_check
    gaps = np.diff(stamps_ns) * 1e-9
    late = np.maximum(gaps - period, 0.0)
    seconds = f"with torque frames for {float(gaps.sum()):.0f} s"
    found = [
        *idle_check.measures,
        measure(f"lateness of 99.9 % of the cycles, {seconds}", float(np.quantile(late, 0.999)) * 1e3, "ms"),
        measure(f"worst lateness, {seconds}", float(late.max()) * 1e3, "ms", most=LONGEST_GAP * period * 1e3),
        measure(f"late cycles, {seconds}", float((late > LATE * period).mean()), "", most=LATE_SHARE),
    ]
    return check_from_measures(idle_check.code, found, RATE_REMEDY)


def noise_check(
    idle: IdleRecording, described: ArmDescription, model: ArmModel, limits: MotionLimits, mass_matrix: Vector
) -> Check:
    """Return the check `noise`: position noise at rest, and the velocity and torque that filter and gains make of it.

    Args:
        idle: idle recording of the arm at rest.
        described: description by the open arm, with the encoders' steps.
        model: model with the section `control` of the description.
        limits: limits with the gains.
        mass_matrix: the model's mass matrix where the arm stands, shape (joints, joints).
    """
    if not idle.usable:
        return failed_check("noise", "not every axis answers as it should", "Check bus and encoders.")
    names, period = model.chain.names, idle.period
    position = idle.position
    time = np.linspace(-1.0, 1.0, len(position))[:, None]
    slope = (time * position).sum(axis=0) / (time**2).sum()
    noise = position - position.mean(axis=0) - slope * time
    gain = 1.0 - np.exp(-2.0 * np.pi * np.asarray(model.config.control.velocity_cutoff) * period)
    velocity = np.zeros_like(noise)
    for k in range(1, len(noise)):
        velocity[k] = velocity[k - 1] + gain * ((noise[k] - noise[k - 1]) / period - velocity[k - 1])
    torque = (limits.kp * noise + limits.kd * velocity) @ mass_matrix.T
    angle = joint_units(model.chain.revolute, "rad", "m")
    speed = joint_units(model.chain.revolute, "rad/s", "m/s")
    force = joint_units(model.chain.revolute, "N m", "N")
    step = described.position_resolution
    # Where the driver does not state its encoder's resolution, only the effect of noise on the loop can be judged.
    steps = np.where(step > 0.0, STEPS_OF_NOISE * step, np.inf)
    found = [
        *measures("position noise, standard deviation", noise.std(axis=0), angle, names, most=steps),
        *measures("position noise, peak", np.abs(noise).max(axis=0), angle, names),
        *measures("velocity after the filter, standard deviation", velocity.std(axis=0), speed, names),
        *measures(
            "velocity after the filter, peak", np.abs(velocity).max(axis=0), speed, names,
            most=VELOCITY_NOISE * limits.velocity,
        ),
        *measures(
            "torque that the gains make of it, standard deviation", torque.std(axis=0), force, names,
            most=TORQUE_NOISE * limits.torque,
        ),
    ]  # fmt: skip
    return check_from_measures(
        "noise",
        found,
        "Check shielding and grounding of the encoder, keep the arm's surroundings still, or lower "
        "control.velocity_cutoff and kd.",
    )


def unreachable_check(error: ArmError) -> Check:
    """Return the failed check `identities` of an arm that could not be opened or recorded, with the reason."""
    remedy = UNREACHABLE_REMEDY
    if isinstance(error, PositionUnknown):
        remedy = "Do this; only a person can tell where the arm is."
    elif isinstance(error, AnotherDrive):
        remedy = (
            "Put the drives back in place; after a repair calibrate zero and torque scale, then enter the new identity."
        )
    elif isinstance(error, UnsuitableDrive):
        remedy = "Change the description as it says, or take another drive; `ident bus probe ARM` asks for all at once."
    return Check("identities", Verdict.FAILED, (), str(error), remedy)
