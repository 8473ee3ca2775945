"""Check what is known before an arm is opened: its description, the motion made for it, what is proven of that."""

from __future__ import annotations

import numpy as np

from drivers.can.bus_load import Budget
from ident_service.config.motion_limits import MotionLimits, Vector, motion_limits
from ident_service.errors import IdentError, ModelError, MotionRefused
from ident_service.excitation.limit_proof import proof_of, violations
from ident_service.excitation.motion_file import Excitation
from ident_service.model.arm_model import ArmModel
from ident_service.model.collision import CollisionModel
from ident_service.model.kinematics import frame_origins
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.after_stop import after_stop, joints_with_weight
from ident_service.motion.clearance import motion_stop_clearance, trajectory_clearance
from ident_service.motion.run import unhurried
from ident_service.motion.run_plan import Destination, PointToPointPlan
from ident_service.motion.stop_trajectory import require_stops_within_limits
from ident_service.motion.ticket import (
    Check,
    Measure,
    Verdict,
    check_from_measures,
    failed_check,
    joint_units,
    measure,
    measures,
    skipped_check,
)
from ident_service.motion.trajectory import PathReference, Reference, plan_trajectory, rest
from ident_service.preflight.stability import INERTIA, LEAST_GAIN_MARGIN, delay_of, stability

# What drives may take to notice that the host is gone where joints can fall: what falls freely has sunk 5 cm after it
# and moves at 1 m/s, and others take no longer (moteus 0.1 s).
LONGEST_SILENCE = 0.1
LONG_SILENCE_REMEDY = (
    "Shorten the drives' watchdog (torque_deadline, heartbeats.host_timeout, guarding, watchdog_time), or say "
    "in driver.watchdog_reason why this arm may go on for longer."
)
NEAR_HOME = 0.1  # rad or m: people lead an arm home to a few hundredths
HOLDABLE = 0.8  # of a torque limit: what holding may take, so that something is left to correct with
# Times along a motion and along a way at which points' speeds are taken: of the shipped WAM's to a thousandth.
_SPEEDS, _LEG_SPEEDS = 4000, 400
_SLOWER = "Lower the joints' velocity limits, or raise driver.limits.velocity as far as the people near it allow."
_POSTURES = 8  # of the motion, at which the coupled loop is judged


@unhurried()
def configuration_check(model: ArmModel, bus_budget: Budget | None = None) -> Check:
    """Return the check `configuration`: limits, gains, feasible prior, secured stop, short watchdogs, room on the bus.

    Args:
        model: of the arm.
        bus_budget: load of the arm's buses; None for an arm on none.
    """
    code, remedy = "configuration", "Complete the arm's description; `ident config check` names every place."
    try:
        limits = motion_limits(model.config)
        if model.prior is None:
            raise MotionRefused(f"{model.config.name}: computed torque needs prior parameters")
        dynamics = InverseDynamics(model.chain, model.layout, model.prior)
        after_stop(model, limits)
        smallest = float(np.linalg.eigvalsh(dynamics.mass_matrix(limits.home)).min())
    except IdentError as error:
        return failed_check(code, str(error), remedy)
    if not smallest > 0.0:
        return failed_check(
            code,
            "the prior's mass matrix at home is not positive definite: no real body has these parameters",
            "Give prior parameters of a feasible identification or of a CAD model.",
        )
    if too_long := long_silence_text(model, limits, model.config.watchdog):
        return failed_check(code, too_long, LONG_SILENCE_REMEDY)
    if bus_budget is not None and not bus_budget.fits:
        return failed_check(code, bus_budget.reason, bus_budget.remedy)
    return Check(code, Verdict.PASSED)


def long_silence_text(model: ArmModel, limits: MotionLimits, watchdog_seconds: float | None) -> str:
    """Return a sentence if drives act on too long without host and joints can fall; empty if not, or not known.

    It is empty, too, where the description says why that is safe (`watchdog_reason`).

    Args:
        model: model of the arm, with a prior.
        limits: of the arm.
        watchdog_seconds: time after which the drives give up torque [s]; None where unknown.
    """
    if watchdog_seconds is None or watchdog_seconds <= LONGEST_SILENCE or model.config.watchdog_reason:
        return ""
    if not (falling := joints_with_weight(model, limits)):
        return ""
    return (
        f"drives go on for {watchdog_seconds:g} s when the host is gone, and {', '.join(falling)} can fall: at most "
        f"{LONGEST_SILENCE:g} s"
    )


def motion_fits_check(model: ArmModel, excitation: Excitation) -> Check:
    """Return the check `motion_fits`: passed if the motion was made for this description (`motion_sha256`)."""
    code, remedy = "motion_fits", "Design the motion again for the description as it is now."
    if excitation.arm_sha256 != model.config.motion_sha256:
        return failed_check(code, f"the {excitation.name} motion was made for another description of the arm", remedy)
    if excitation.path.joints != model.chain.joints:
        return failed_check(
            code, f"a motion of {excitation.path.joints} joints for an arm of {model.chain.joints}", remedy
        )
    return Check(code, Verdict.PASSED)


@unhurried()
def motion_proven_check(model: ArmModel, limits: MotionLimits, excitation: Excitation) -> Check:
    """Return the check `motion_proven`: motion and sampled stops keep the limits, the way from home the clearance."""
    code, remedy = "motion_proven", "Design the motion again, with larger margins or a smaller share of the limits."
    if model.config.point_speed_limit is not None:
        remedy = f"{remedy} {_SLOWER}"
    try:
        proof = proof_of(excitation.path, model, limits, CollisionModel(model))
        found = violations(proof, model, limits)
        nearest = motion_stop_clearance(excitation.path, limits, model)
    except (ModelError, MotionRefused) as error:
        return failed_check(code, str(error), remedy)
    try:
        require_stops_within_limits(excitation.path, limits, model.chain.names)
    except MotionRefused as error:
        found.append(str(error))
    asked, names = proof.demands, model.chain.names
    taken: list[Measure] = []
    for key in ("velocity", "torque"):
        if (peak := getattr(asked, key)) is not None:
            share = peak / getattr(limits, key)
            taken += measures(f"{key}, share of the limit", share, ("",) * len(names), names, most=np.ones(len(names)))
    seconds = np.linspace(0.0, excitation.path.duration, _SPEEDS)
    taken += point_speed_measures(model, excitation.path.at(seconds)[0], seconds, "of the motion")
    least = model.config.workspace.clearance
    for what, clearance in (("clearance", proof.clearance), ("clearance on the way from home", proof.approach)):
        if clearance is not None and clearance.pair is not None:
            taken.append(measure(what, clearance.lower_bound, "m", least=least))
    if nearest.pair is not None:
        taken.append(measure("clearance of stops", nearest.distance, "m", least=0.0))
        if nearest.distance <= 0.0:
            found.append(f"a stop out of the motion at {nearest.time:.2f} s would touch: {nearest.pair}")
    return failed_check(code, "; ".join(found), remedy, taken) if found else check_from_measures(code, taken, remedy)


def point_speed_measures(model: ArmModel, positions: Vector, sample_times: Vector, name_suffix: str) -> list[Measure]:
    """Return a list of one measure, the fastest frame's speed [m/s] with its limit; empty where none is described.

    Args:
        model: of the arm.
        positions: along a motion [rad or m], shape (samples, joints).
        sample_times: of the samples [s], shape (samples,).
        name_suffix: suffix of the measure's name.
    """
    limit = model.config.point_speed_limit
    if limit is None:
        return []
    steps = np.diff(frame_origins(model.chain, positions), axis=0) / np.diff(sample_times)[:, None, None]
    fastest = float(np.linalg.norm(steps, axis=2).max())
    return [measure(f"speed of elbow and tip {name_suffix} (driver.limits.velocity)", fastest, "m/s", most=limit)]


def _leg_speeds(model: ArmModel, leg: Reference, what: str) -> list[Measure]:
    seconds = np.linspace(0.0, leg.duration, _LEG_SPEEDS)
    if model.config.point_speed_limit is None or not leg.duration > 0.0:
        return []
    return point_speed_measures(model, np.array([leg.at(float(time)).position for time in seconds]), seconds, what)


@unhurried()
def stability_check(model: ArmModel, limits: MotionLimits, excitation: Excitation | None) -> Check:
    """Return the check `stability`: gains stable at home, mid-range and on the motion; skipped for position drives.

    Drives that are given positions close the loop by themselves, with gains of their maker's tool.
    """
    if getattr(model.config.driver, "streams", "torque") == "position":
        return skipped_check("stability", "the drives close the position loop by themselves (driver.streams: position)")
    path = None if excitation is None or excitation.path.joints != model.chain.joints else excitation.path
    postures = np.vstack([limits.home, 0.5 * (limits.lower + limits.upper)])
    if path is not None:
        postures = np.vstack([postures, path.at(np.linspace(0.0, path.duration, _POSTURES))[0]])
    report = stability(model, limits, delay_of(model.config), postures)
    names, ones = model.chain.names, ("",) * model.chain.joints
    radius, gain, more = (
        np.array([getattr(one, key) for one in report.joints]) for key in ("radius", "gain_margin", "delay_margin")
    )
    most = np.full(len(names), np.nextafter(1.0, 0.0))
    found = [
        *measures("largest spectral radius", radius, ones, names, most=most),
        *measures("gain margin", gain, ones, names, least=np.full(len(names), LEAST_GAIN_MARGIN)),
        *measures("delay margin", more * 1e3, ("ms",) * len(names), names),
    ]
    if report.coupled_radius is not None:
        found.append(measure("largest spectral radius, all joints", report.coupled_radius, "", most=float(most[0])))
    return check_from_measures(
        "stability",
        found,
        f"Lower kp and kd, raise control.velocity_cutoff or control.rate, or give the prior its drive inertia; inertia "
        f"is taken to be {INERTIA[0]:g} to {INERTIA[1]:g} times the model's.",
    )


def distance_from_home_text(model: ArmModel, limits: MotionLimits, position: Vector) -> str:
    """Return in words how far joints stand from home; an empty text if none is farther than `NEAR_HOME`.

    Args:
        model: of the arm.
        limits: limits of the arm, with its home.
        position: present position of the arm [rad or m], shape (joints,).
    """
    units = joint_units(model.chain.revolute, "rad", "m")
    far = np.abs(position - limits.home)
    return ", ".join(
        f"{name} {away:.2g} {unit} away"
        for name, away, unit in zip(model.chain.names, far, units, strict=True)
        if away > NEAR_HOME
    )


def path_home_check(model: ArmModel, limits: MotionLimits, position: Vector) -> Check:
    """Return the check `ways_clear`: the straight way home is clear, and elbow and tip are slow enough on it."""
    code = "ways_clear"
    try:
        ((_, leg),) = PointToPointPlan(Destination.HOME).legs(model, position, limits)
    except (ModelError, MotionRefused) as error:
        return failed_check(code, str(error), "Move the arm by hand to where the straight path home is free.")
    found = [measure("the way home, length", leg.duration, "s"), *_leg_speeds(model, leg, "on the way home")]
    return check_from_measures(code, found, _SLOWER)


def paths_check(model: ArmModel, limits: MotionLimits, excitation: Excitation, position: Vector) -> Check:
    """Return the check `ways_clear`: ways from `position` to the motion and back keep limits, clearance and speed.

    Args:
        model: of the arm.
        limits: of the arm.
        excitation: the motion.
        position: present position of the arm [rad or m], shape (joints,).
    """
    code = "ways_clear"
    motion = PathReference(excitation.path)
    least = model.config.workspace.clearance
    found: list[Measure] = []
    try:
        collision = CollisionModel(model)
        ends = (motion.at(0.0), motion.at(motion.duration))
        for what, leg in (
            ("the way to the motion", plan_trajectory(rest(position), ends[0], limits)),
            ("the way back", plan_trajectory(ends[1], rest(position), limits)),
        ):
            found.append(measure(f"{what}, length", leg.duration, "s"))
            found += _leg_speeds(model, leg, f"on {what}")
            if collision.pairs:
                clearance = trajectory_clearance(collision, leg, limits, least)
                found.append(measure(f"{what}, clearance", clearance.lower_bound, "m", least=least))
    except (ModelError, MotionRefused) as error:
        return failed_check(
            code, str(error), "Move the arm by hand to where motions begin (home), then check again.", found
        )
    return check_from_measures(code, found, "Move the arm by hand to where motions begin (home), then check again.")
