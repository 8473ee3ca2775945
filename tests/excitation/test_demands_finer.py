"""No limit is found to be broken by sampling a thousand times finer than a design looks; and the bounds are tight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from helpers.examples import some
from helpers.random_arms import model_around, random_chain, random_delta
from hypothesis import given
from hypothesis import strategies as st
from motions import random_fourier_path, random_path, random_posture_path

from ident_service.config.load import load_arm
from ident_service.config.motion_design import Supply
from ident_service.config.motion_limits import MotionLimits
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.design import samples_per_period
from ident_service.excitation.limit_proof import (
    PeakBounds,
    peak_bounds,
    power_bounds,
    time_intervals,
    torque_enclosures,
)
from ident_service.excitation.trajectory import FourierBasis, FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel, arm_model, control_model
from ident_service.model.parameter_layout import Layout
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
SEEDS = st.integers(0, 2**32 - 1)
TERMS = ("drive_inertia", "viscous", "coulomb", "offset", "stribeck", "quadratic", "viscous_asymmetry")
ROUNDING = 1e-9


def random_arm(seed: int, joints: int) -> ArmModel:
    """A random mechanism with every friction term, coupled drives and a supply."""
    rng = np.random.default_rng(seed)
    coupling = np.eye(joints) + 0.3 * rng.normal(size=(joints, joints)) * (rng.random() < 0.5)
    chain = replace(random_chain(rng, joints), coupling=coupling)
    layout = Layout(chain.revolute, TERMS, tuple(rng.uniform(0.1, 2.0, size=joints)))
    model = model_around(chain, layout)
    supply = Supply(power=1.0, loss=tuple(rng.uniform(0.0, 0.1, size=joints)), standby=rng.uniform(0.0, 5.0))
    return replace(model, prior=random_delta(rng, layout), config=model.config.model_copy(update={"supply": supply}))


def without_dry_friction(model: ArmModel) -> ArmModel:
    """The bounds take dry friction for either way wherever a drive turns round, which costs tightness."""
    assert model.prior is not None
    delta = model.prior.copy()
    delta[model.layout.term_columns("coulomb")] = 0.0
    delta[model.layout.term_columns("stribeck")] = 0.0
    return replace(model, prior=delta)


def supplied(model: ArmModel, torque: Array, velocity: Array) -> Array:
    """What the drives draw [W], written down once more from the description."""
    supply = model.config.supply
    assert supply is not None
    C = model.chain.coupling
    effort, rate = np.linalg.solve(C.T, torque.T).T, velocity @ C.T
    drawn = effort * rate + np.asarray(supply.loss) * effort**2
    return np.asarray(supply.standby + np.maximum(drawn, 0.0).sum(axis=1))


def fine_samples(path: FourierPath | PosturePath, finer: int) -> Iterator[Array]:
    """Times of a grid `finer` times as fine as a design's, a block at a time."""
    if isinstance(path, FourierPath):
        basis = FourierBasis(path.series.base_frequency, path.series.a.shape[1], path.periods, path.ramp)
        step = path.series.period / samples_per_period(basis) / finer
    else:
        step = path.duration / 120 / finer
    for begin, end in path.distinct:
        count = int(np.ceil((end - begin) / step)) + 1
        for block in range(0, count, 20_000):
            yield begin + np.arange(block, min(block + 20_000, count)) * (end - begin) / (count - 1)


def sampled(path: FourierPath | PosturePath, model: ArmModel, finer: int) -> dict[str, Array]:
    """The largest that is found of everything, by the names of `PeakBounds`."""
    found: dict[str, Array] = {}
    delta = control_model(model).prior
    for time in fine_samples(path, finer):
        q, dq, ddq, jerk = path.at(time)
        torque = np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, q, dq, ddq), delta)
        values = {"highest": q.max(axis=0), "lowest": q.min(axis=0)}
        sizes = {"velocity": dq, "acceleration": ddq, "jerk": jerk, "torque": torque}
        values |= {name: np.abs(size).max(axis=0) for name, size in sizes.items()}
        values["power"] = supplied(model, torque, dq).max()
        for name, value in values.items():
            best = np.minimum if name == "lowest" else np.maximum
            found[name] = best(found.get(name, value), value)
    return found


def assert_bounds(asked: PeakBounds, found: dict[str, Array]) -> None:
    assert (asked.lowest <= found["lowest"] + ROUNDING).all()
    for name in ("highest", "velocity", "acceleration", "jerk", "torque", "power"):
        bound = np.asarray(getattr(asked, name))
        assert (bound >= found[name] - ROUNDING * (1.0 + np.abs(found[name]))).all(), name


@pytest.mark.slow
@some(3)
@given(seed=SEEDS, joints=st.integers(1, 3))
def test_a_thousand_times_finer_nothing_exceeds_the_bounds(seed: int, joints: int) -> None:
    model = random_arm(seed, joints)
    path = random_fourier_path(seed, joints, harmonics=1 + seed % 3, ramps=False)
    assert_bounds(peak_bounds(path, model), sampled(path, model, 1000))


@pytest.mark.slow
@some(2)
@given(seed=SEEDS)
def test_nor_in_the_ramps(seed: int) -> None:
    model = random_arm(seed, 2)
    path = random_fourier_path(seed, 2, harmonics=2)
    assert_bounds(peak_bounds(path, model), sampled(path, model, 1000))


@pytest.mark.slow
@some(2)
@given(seed=SEEDS)
def test_nor_on_segments_between_postures(seed: int) -> None:
    model = random_arm(seed, 2)
    path = random_posture_path(seed, 2)
    assert_bounds(peak_bounds(path, model), sampled(path, model, 1000))


@pytest.mark.slow
@some(3)
@given(seed=SEEDS, share=st.floats(0.3, 1.5))
def test_a_motion_without_violations_keeps_random_limits_a_thousand_times_finer(seed: int, share: float) -> None:
    model, path = random_arm(seed, 2), random_fourier_path(seed, 2, harmonics=2, ramps=bool(seed % 2))
    rng = np.random.default_rng(seed)
    found = sampled(path, model, 1000)
    # Limits about what is asked: some below, some hardly above, some far above.
    wide = {
        name: value * (1.0 + share * rng.choice([-0.1, 1e-4, 1.0], p=[0.1, 0.4, 0.5]))
        for name, value in found.items()
        if name not in ("lowest", "highest")
    }
    limits = MotionLimits(
        lower=found["lowest"] - 1e-3, upper=found["highest"] + 1e-3,
        following_error=np.ones(2), kp=np.ones(2), kd=np.ones(2), home=np.zeros(2),
        **{name: wide[name] for name in ("velocity", "acceleration", "jerk", "torque")},
    )  # fmt: skip
    violations = peak_bounds(path, model).violations(model.chain.names, limits, Supply(power=float(wide["power"])))
    for name in ("velocity", "acceleration", "jerk", "torque"):
        for k, joint in enumerate(model.chain.names):
            if found[name][k] > wide[name][k]:
                assert any(text.startswith(f"{joint}: {name} ") for text in violations)
    if found["power"] > wide["power"]:
        assert any(text.startswith("supply: ") for text in violations)


@pytest.mark.slow
@some(5)
@given(seed=SEEDS, joints=st.integers(1, 3))
def test_torque_and_power_lie_inside_their_enclosures_stretch_by_stretch(seed: int, joints: int) -> None:
    model, path = random_arm(seed, joints), random_path(seed, joints)
    assert model.prior is not None
    assert model.config.supply is not None
    rng = np.random.default_rng(seed)
    # Long stretches too: then the enclosures have to do with more than rounding.
    cells = time_intervals(path, float(rng.choice([0.01, 0.005, 0.0025])) / path.highest_frequency(0.0, path.duration))
    enclosed = torque_enclosures(cells, model, model.prior)
    drawn = power_bounds(enclosed, cells.enclosures(1), model.config.supply, model.chain.coupling)
    picked = rng.choice(len(cells.time), size=min(20, len(cells.time)), replace=False)
    for at in picked:
        q, dq, ddq, _ = path.at(cells.time[at] + cells.half[at] * np.linspace(-1.0, 1.0, 1000))
        torque = np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, q, dq, ddq), model.prior)
        for joint, enclosure in enumerate(enclosed):
            assert torque[:, joint].max() <= enclosure.highest[at] * (1 + ROUNDING) + 2 * ROUNDING * enclosure.size[at]
            assert torque[:, joint].min() >= enclosure.lowest[at] - 2 * ROUNDING * enclosure.size[at]
        assert supplied(model, torque, dq).max() <= drawn[at] * (1 + ROUNDING)


@some(5)
@given(seed=SEEDS, joints=st.integers(1, 3))
def test_bounds_are_tight_to_a_few_thousandths(seed: int, joints: int) -> None:
    model, path = without_dry_friction(random_arm(seed, joints)), random_path(seed, joints)
    asked, found = peak_bounds(path, model), sampled(path, model, 20)
    swing = found["highest"] - found["lowest"]
    assert (asked.highest <= found["highest"] + 1e-3 * swing).all()
    assert (asked.lowest >= found["lowest"] - 1e-3 * swing).all()
    for name in ("velocity", "acceleration", "jerk", "torque"):
        assert (getattr(asked, name) <= found[name] * (1.0 + 4e-3)).all(), name
    # Where one drive begins to draw what another no longer does, the bound adds the most of both.
    assert asked.power is not None
    assert asked.power <= found["power"] * (1.0 + 2e-2)


@some(5)
@given(seed=SEEDS)
def test_slack_is_what_a_bound_may_be_above_the_truth(seed: int) -> None:
    model, path = without_dry_friction(random_arm(seed, 2)), random_path(seed, 2)
    asked, found = peak_bounds(path, model), sampled(path, model, 20)
    for name, slack in asked.slack.items():
        if name == "power":
            continue
        bound = getattr(asked, name)
        excess = found[name] - bound if name == "lowest" else bound - found[name]
        assert (slack >= 0.0).all()
        assert (excess <= slack + 1e-3 * (1.0 + np.abs(bound))).all(), name


@some(5)
@given(seed=SEEDS)
def test_bounds_are_reached_about_when_they_are_said_to_be(seed: int) -> None:
    model, path = random_arm(seed, 2), random_path(seed, 2)
    asked = peak_bounds(path, model)
    for k in range(2):
        assert path.at(asked.when["highest"][k])[0][k] >= asked.highest[k] - asked.slack["highest"][k] - 1e-3
        speed = abs(path.at(asked.when["velocity"][k])[1][k])
        assert speed == pytest.approx(asked.velocity[k], rel=2e-2)


def test_the_power_of_a_single_joint_is_torque_times_velocity_and_heat() -> None:
    # One wheel of unit inertia, q = 0.5 sin(2 pi t): tau = ddq, and both losses and motion are known.
    config = load_arm("planar2").model_copy(update={"supply": Supply(power=100.0, loss=0.01, standby=3.0)})
    model = arm_model(config)
    delta = np.zeros(model.layout.size)
    delta[model.layout.names.index("Ia1")] = 1.0
    rate = 2.0 * np.pi
    path = random_fourier_path(0, 2, 1, ramps=False)
    series = replace(path.series, base_frequency=1.0, a=np.array([[0.5 * rate], [0.0]]), b=np.zeros((2, 1)))
    asked = peak_bounds(FourierPath(series, 1), replace(model, prior=delta))
    time = np.linspace(0.0, 1.0, 100_001)
    tau, speed = -0.5 * rate**2 * np.sin(rate * time), 0.5 * rate * np.cos(rate * time)
    expected = 3.0 + np.maximum(tau * speed + 0.01 * tau**2, 0.0).max()
    assert asked.power == pytest.approx(expected, rel=1e-3)
    assert asked.power >= expected


def test_a_supply_that_is_too_weak_is_named() -> None:
    model, path = random_arm(7, 2), random_fourier_path(7)
    asked = peak_bounds(path, model)
    assert asked.power is not None
    n = np.full(2, 1e9)
    limits = MotionLimits(-n, n, n, n, n, n, n, n, n, 0.0 * n)
    assert asked.violations(model.chain.names, limits, Supply(power=asked.power)) == []
    (found,) = asked.violations(model.chain.names, limits, Supply(power=0.9 * asked.power))
    assert found == f"supply: {asked.power:.1f} W exceeds {0.9 * asked.power:g} W"
    assert asked.violations(model.chain.names, limits, None) == []


@pytest.mark.parametrize("name", ["lowest", "highest", "velocity", "acceleration", "jerk", "torque", "power"])
def test_a_bound_that_is_no_number_keeps_no_limit(name: str) -> None:
    model, path = random_arm(7, 2), random_fourier_path(7)
    asked = peak_bounds(path, model)
    broken = replace(asked, **{name: getattr(asked, name) * np.nan})
    n = np.full(2, 1e9)
    limits = MotionLimits(-n, n, n, n, n, n, n, n, n, 0.0 * n)
    assert len(broken.violations(model.chain.names, limits, Supply(power=1e9))) == (1 if name == "power" else 2)


@pytest.mark.slow
def test_the_published_motion_of_the_wam_a_thousand_times_finer(wam7: ArmModel) -> None:
    path = excitation(wam7, "identification").path
    assert_bounds(peak_bounds(path, wam7), sampled(path, wam7, 1000))
