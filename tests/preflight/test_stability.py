"""The stability verdict against what is known: closed forms, long simulations of the loop, the shipped arms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flight_bench import flight_config
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from motion.motion_bench import PRIOR

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import UsageError
from ident_service.model.arm_model import ArmModel, arm_model, control_model
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.preflight.stability import Loop, spectral_radius, stability

Array = np.ndarray
NO_FILTER = 1e9  # Hz: the low-pass passes everything


def config_at_1_kHz(**changes: Any) -> ArmConfig:  # noqa: N802 - a unit
    return flight_config(control={"rate": 1000.0}, **changes)


def loop(kp: float, kd: float, period: float = 1e-3, cutoff: float = NO_FILTER, delay: float = 1.0) -> Loop:
    return Loop(np.array([kp]), np.array([kd]), period, cutoff, delay)


def radius_of(one: Loop, ratio: float = 1.0) -> float:
    return float(spectral_radius(one, np.array([[ratio]])))


def simulated_growth(one: Loop, ratio: float, cycles: int) -> float:
    """The recursion written out as the loop runs it: how much larger the last tenth is than the one before."""
    h, g, kp, kd = one.period, float(one.filter_gain[0]), float(one.kp[0]), float(one.kd[0])
    q, dq, before, filtered = 1e-3, 0.0, 1e-3, 0.0
    whole = int(one.delay)
    late = one.delay - whole
    queue = [0.0] * (whole + 1)  # alpha of the last cycles, oldest first
    sizes = np.empty(cycles)
    for k in range(cycles):
        filtered += g * ((q - before) / h - filtered)
        before = q
        alpha = -kp * q - kd * filtered
        for share, acting in ((late, queue[0]), (1.0 - late, queue[1])):
            q += share * h * dq + 0.5 * (share * h) ** 2 * ratio * acting
            dq += share * h * ratio * acting
        queue = [*queue[1:], alpha]
        sizes[k] = abs(q) + abs(dq) * h
        if not sizes[k] < 1e100:
            return np.inf
        if sizes[k] < 1e-250:
            return 0.0  # settled; below, numbers stop getting smaller
    tenth = cycles // 10
    return float(sizes[-tenth:].max() / sizes[-2 * tenth : -tenth].max())


def test_a_proportional_loop_alone_is_never_stable() -> None:
    assert radius_of(loop(400.0, 0.0)) > 1.0


def test_the_radius_is_the_characteristic_polynomials() -> None:
    """Without the filter, one cycle of delay: z (z - 1)^2 z + h^2/2 (z + 1) ((kp + kd/h) z - kd/h) = 0."""
    kp, kd, h = 900.0, 60.0, 2e-3
    controller = 0.5 * h * h * np.array([kp + kd / h, -kd / h])
    polynomial = np.polyadd([1.0, -2.0, 1.0, 0.0, 0.0], np.polymul([1.0, 1.0], controller))
    assert radius_of(loop(kp, kd, h)) == pytest.approx(np.abs(np.roots(polynomial)).max(), abs=1e-9)


def test_velocity_feedback_alone_has_its_known_gain_limit() -> None:
    """Of the mean velocity: z^3 - z^2 + kd h/2 (z + 1) = 0, and (z - 1)/(z + 1) = i tan(angle/2) on the unit circle.

    So z^2 i tan(angle/2) = -kd h/2, which is real for an angle of pi/4: kd h = 2 tan(pi/8).
    """
    critical = 2.0 * np.tan(np.pi / 8.0) / 1e-3
    # Below, what remains is the position's own pole, which nothing draws home.
    assert radius_of(loop(0.0, 0.999 * critical)) == pytest.approx(1.0, abs=1e-9)
    assert radius_of(loop(0.0, 1.001 * critical)) > 1.0 + 1e-4


@settings(max_examples=60)
@given(
    kp=st.floats(50.0, 30000.0),
    damping=st.floats(0.1, 2.0),
    cutoff=st.floats(10.0, 300.0),
    period=st.sampled_from([1e-3, 2e-3]),
    delay=st.floats(1.0, 6.0),
    ratio=st.floats(0.1, 4.0),
)
def test_the_verdict_agrees_with_a_long_simulation(
    kp: float, damping: float, cutoff: float, period: float, delay: float, ratio: float
) -> None:
    one = loop(kp, 2.0 * damping * np.sqrt(kp), period, cutoff, delay)
    radius = radius_of(one, ratio)
    assume(abs(radius - 1.0) > 3e-3)
    growth = simulated_growth(one, ratio, 6000)
    assert (growth < 1.0) == (radius < 1.0)


def test_whole_delays_are_the_limit_of_fractions() -> None:
    for whole in (1.0, 2.0, 5.0):
        one = loop(400.0, 40.0, cutoff=30.0, delay=whole)
        assert radius_of(replace(one, delay=whole + 1e-7)) == pytest.approx(radius_of(one), abs=1e-6)
        assert radius_of(replace(one, delay=whole - 1e-7)) == pytest.approx(radius_of(one), abs=1e-6)


def test_stated_margins_are_where_the_loop_turns() -> None:
    model = arm_model(config_at_1_kHz())
    (one, _) = stability(model, motion_limits(model.config)).joints
    alone = loop(400.0, 40.0, cutoff=30.0)
    assert radius_of(alone, 0.999 * one.gain_margin) < 1.0 < radius_of(alone, 1.001 * one.gain_margin)
    late = one.delay_margin / 1e-3
    assert (
        radius_of(replace(alone, delay=1.0 + 0.999 * late)) < 1.0 < radius_of(replace(alone, delay=1.0 + 1.01 * late))
    )


@pytest.mark.parametrize("name", ["wam7", "planar2", "sixaxis", "threelink"])
def test_shipped_gains_are_stable(name: str) -> None:
    model = arm_model(load_arm(name))
    report = stability(model, motion_limits(model.config))
    assert report.stable, report.objections()
    assert report.coupled_radius is not None


def bench(**gains: float) -> ArmModel:
    joints = config_at_1_kHz().joints
    changed = {name: joint.model_copy(update=gains) for name, joint in joints.items()}
    return arm_model(config_at_1_kHz(joints={name: joint.model_dump() for name, joint in changed.items()}))


def test_gains_that_are_too_high_are_named_with_their_margin() -> None:
    model = bench(kp=40000.0, kd=400.0)
    report = stability(model, motion_limits(model.config))
    assert not report.stable
    assert report.objections()[0].startswith("shoulder: unstable")
    assert report.joints[0].gain_margin < 2.0


def test_more_delay_makes_stable_gains_unstable() -> None:
    model = bench(kp=2500.0, kd=100.0)
    limits = motion_limits(model.config)
    reports = [stability(model, limits, delay) for delay in (1, 3, 9)]
    assert reports[0].stable
    assert not reports[2].stable
    first, third, ninth = (report.joints[0].delay_margin for report in reports)
    assert third == pytest.approx(first - 2e-3, abs=1e-6)
    assert 3e-3 < first < 8e-3
    assert ninth == 0.0


def test_an_unknown_delay_is_refused() -> None:
    model = bench()
    with pytest.raises(UsageError, match="delay_cycles=0"):
        stability(model, motion_limits(model.config), 0)


def test_without_a_prior_each_joint_is_judged_by_itself() -> None:
    model = replace(arm_model(config_at_1_kHz()), prior=None)
    report = stability(model, motion_limits(model.config))
    assert report.coupled_radius is None
    assert report.stable


def test_a_link_without_known_drive_inertia_is_taken_to_be_no_lighter_than_modelled() -> None:
    bare = {name: value for name, value in PRIOR.items() if not name.startswith("Ia2")}
    model = arm_model(config_at_1_kHz(prior=bare))
    assert [one.lightest for one in stability(model, motion_limits(model.config)).joints] == pytest.approx([0.5, 1.0])


def test_stated_drive_inertia_is_in_the_law_and_so_leaves_the_margins_alone() -> None:
    """The torque for a wanted acceleration grows with the inertia, so that the loop gain stays the designed one."""
    bare = {name: value for name, value in PRIOR.items() if not name.startswith("Ia2")}
    joints = config_at_1_kHz().joints
    said = {name: joint.model_dump() | {"drive_inertia": 0.1} for name, joint in joints.items()}
    posture = np.array([[0.3, -0.2]])
    without, with_ = (arm_model(config_at_1_kHz(prior=bare, **changes)) for changes in ({}, {"joints": said}))
    limits = motion_limits(without.config)
    own = np.diag(InverseDynamics(without.chain, without.layout, without.prior).mass_matrix(posture[0]))
    before, after = (stability(model, limits, postures=posture).joints for model in (without, with_))
    for k, beyond in enumerate((0.1 - 0.02, 0.1)):  # the prior knows 0.02 of the shoulder's
        assert after[k].gain_margin == pytest.approx(before[k].gain_margin)
        # What is stated is there at least; the links may be half as heavy.
        assert after[k].lightest == pytest.approx((0.5 * own[k] + beyond) / (own[k] + beyond))
    assert [one.lightest for one in before] == pytest.approx([0.5, 1.0])


def test_a_stable_loop_without_margin_is_objected_to() -> None:
    first = stability(arm_model(config_at_1_kHz()), motion_limits(config_at_1_kHz())).joints[0]
    factor = first.gain_margin / 1.9
    heavy = {name: value for name, value in PRIOR.items() if not name.startswith("Ia")}  # so no link is lighter
    joints = {name: joint.model_dump() for name, joint in config_at_1_kHz().joints.items()}
    for joint in joints.values():
        joint |= {"kp": 400.0 * factor, "kd": 40.0 * factor}
    model = arm_model(config_at_1_kHz(joints=joints, prior=heavy))
    report = stability(model, motion_limits(model.config))
    assert all(one.radius < 1.0 for one in report.joints)
    assert [one.gain_margin for one in report.joints] == pytest.approx([1.9, 1.9], rel=1e-6)
    assert report.objections()[0] == "shoulder: gain margin 1.90, at least 2 is needed"
    assert not report.stable


def test_the_wam_is_as_stiff_as_under_its_maker_s_controller_within_a_factor_of_two() -> None:
    config = load_arm("wam7")
    model, limits = control_model(arm_model(config)), motion_limits(config)
    mass = InverseDynamics(model.chain, model.layout, model.prior).mass_matrix(limits.home)
    share = limits.kp * np.diag(mass) / np.array([900.0, 2500.0, 600.0, 500.0, 50.0, 50.0, 8.0])
    assert (share > 0.5).all()
    assert (share < 2.0).all()


@pytest.mark.parametrize("rate", [1000.0, 500.0, 250.0])
def test_the_wam_is_stable_down_to_250_hz(rate: float) -> None:
    """With a gain margin of two where it is driven, and for every inertia of the range where only its simulation runs.

    The gain margin is where the spectral radius of the linearised loop at the model's inertia reaches one, which is
    computed here once more, from the gains alone.
    """
    config = load_arm("wam7")
    config = config.model_copy(update={"control": config.control.model_copy(update={"rate": rate})})
    limits = motion_limits(config)
    report = stability(arm_model(config), limits)
    assert all(one.radius < 1.0 for one in report.joints)
    assert report.coupled_radius is not None
    assert report.coupled_radius < 1.0
    assert report.stable == (rate >= 500.0)
    for k, one in enumerate(report.joints):
        alone = loop(float(limits.kp[k]), float(limits.kd[k]), 1.0 / rate, config.control.velocity_cutoff[k])
        assert radius_of(alone, 0.999 * one.gain_margin) < 1.0 < radius_of(alone, 1.001 * one.gain_margin)


def test_the_coupled_loop_of_the_true_inertia_decays_when_the_report_says_so() -> None:
    """Both joints together with one true inertia of the range, by a simulation that shares no code."""
    model = arm_model(config_at_1_kHz())
    limits = motion_limits(model.config)
    delta = model.prior.copy()
    delta[model.layout.inertial(1)] *= 2.0
    nominal = InverseDynamics(model.chain, model.layout, model.prior).mass_matrix(limits.home)
    true = InverseDynamics(model.chain, model.layout, delta).mass_matrix(limits.home)
    h, g = 1e-3, 1.0 - np.exp(-2.0 * np.pi * 30.0 * 1e-3)
    q, dq, v, before, acting = np.array([1e-3, -1e-3]), np.zeros(2), np.zeros(2), np.array([1e-3, -1e-3]), np.zeros(2)
    for _ in range(4000):
        v = v + g * ((q - before) / h - v)
        before = q
        alpha = -limits.kp * q - limits.kd * v
        acceleration = np.linalg.solve(true, nominal @ acting)
        q, dq, acting = q + h * dq + 0.5 * h * h * acceleration, dq + h * acceleration, alpha
    assert np.abs(q).max() < 1e-9
    assert stability(model, limits).stable
