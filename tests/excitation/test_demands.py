"""What a motion asks of an arm: bounds that hold between grid points, violations by name, refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.examples import some
from helpers.random_arms import model_around, random_chain, random_delta
from hypothesis import given
from hypothesis import strategies as st

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm, shipped_arms
from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.errors import MotionRefused
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.limit_proof import peak_bounds, require_within_limits
from ident_service.excitation.trajectory import FourierPath, FourierSeries
from ident_service.model.arm_model import ArmModel, arm_model

Array = np.ndarray
MOVABLE = ["planar2", "threelink", "wam7", "wam7_sim"]


def bare_model(joints: int) -> ArmModel:
    """A mechanism of which no parameters are known."""
    return model_around(random_chain(np.random.default_rng(0), joints))


def once(series: FourierSeries) -> FourierPath:
    """One period of a series, without ramps."""
    return FourierPath(series, 1)


def series_of(model: ArmModel, purpose: Any) -> FourierSeries:
    """Of the motion that an arm's description asks for."""
    path = excitation(model, purpose).path
    assert isinstance(path, FourierPath)
    return path.series


def fine_extremes(series: FourierSeries, points: int) -> list[tuple[Array, Array]]:
    """Lowest and highest of position and its derivatives on a grid of `points`, a block at a time."""
    lowest, highest = None, None
    for block in np.array_split(np.arange(points) * series.period / points, max(1, points // 20_000)):
        values = series.at(block)
        low, high = [v.min(axis=0) for v in values], [v.max(axis=0) for v in values]
        lowest = low if lowest is None else [np.minimum(x, y) for x, y in zip(lowest, low, strict=True)]
        highest = high if highest is None else [np.maximum(x, y) for x, y in zip(highest, high, strict=True)]
    assert lowest is not None
    assert highest is not None
    return list(zip(lowest, highest, strict=True))


def assert_bounds(series: FourierSeries, points: int) -> None:
    asked = peak_bounds(once(series), bare_model(series.a.shape[0]))
    position, *derivatives = fine_extremes(series, points)
    swing = np.maximum(np.abs(position[0] - series.q0), np.abs(position[1] - series.q0))
    rounding = 1e-12 * (1.0 + np.abs(series.q0) + swing)
    assert (asked.lowest <= position[0] + rounding).all()
    assert (asked.highest >= position[1] - rounding).all()
    # Bounds are worth something only when they are tight.
    assert (asked.lowest >= position[0] - 2e-4 * swing - rounding).all()
    assert (asked.highest <= position[1] + 2e-4 * swing + rounding).all()
    for name, (low, high) in zip(("velocity", "acceleration", "jerk"), derivatives, strict=True):
        peak = np.maximum(-low, high)
        assert (getattr(asked, name) >= peak * (1.0 - 1e-12)).all(), name
        assert (getattr(asked, name) <= peak * (1.0 + 2e-4)).all(), name


@pytest.mark.slow
@some(8)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 3), harmonics=st.integers(1, 3))
def test_peaks_bound_a_thousand_times_finer_sampling(seed: int, joints: int, harmonics: int) -> None:
    rng = np.random.default_rng(seed)
    series = FourierSeries(rng.uniform(0.01, 1.0), *rng.normal(size=(2, joints, harmonics)), rng.normal(size=joints))
    assert_bounds(series, 1000 * 200 * harmonics)


@pytest.mark.parametrize("harmonics", [1, 2, 5, 20, 50])
@pytest.mark.parametrize("shift", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_peaks_bound_a_tall_pulse_beside_a_sharp_trough(harmonics: int, shift: float, sign: float) -> None:
    # Fejer's kernel is a tall pulse between shallow but sharp troughs; a slow wave makes one of them the lowest,
    # and that one lies between two points of the grid.
    w, order = 0.2 * np.pi, np.arange(1, harmonics + 1)
    step = 2.0 * np.pi / (200 * harmonics)
    trough = (round(1.0 / step) + shift) * step
    pulse = trough - 2.0 * np.pi / (harmonics + 1)
    cosine = (weights := 1.0 - order / (harmonics + 1)) * np.cos(order * pulse)
    sine = weights * np.sin(order * pulse)
    cosine[0] -= 0.05 * np.cos(trough)
    sine[0] -= 0.05 * np.sin(trough)
    a, b = sign * sine * order * w, -sign * cosine * order * w
    assert_bounds(FourierSeries(0.1, a[None], b[None], np.array([0.4])), 8 * 200 * harmonics)


def test_torque_is_that_of_the_prior() -> None:
    rng = np.random.default_rng(5)
    bare = bare_model(3)
    series = FourierSeries(0.1, *rng.normal(size=(2, 3, 4)), rng.normal(size=3))
    assert peak_bounds(once(series), bare).torque is None
    delta = random_delta(rng, bare.layout)
    single = peak_bounds(once(series), dataclasses.replace(bare, prior=delta)).torque
    double = peak_bounds(once(series), dataclasses.replace(bare, prior=2.0 * delta)).torque
    assert single is not None
    assert double is not None
    assert (single > 0.0).all()
    np.testing.assert_allclose(double, 2.0 * single)


def limits_of(model: ArmModel, **changes: Array) -> MotionLimits:
    n = model.chain.joints
    wide = {
        field.name: np.full(n, -100.0 if field.name == "lower" else 1e6) for field in dataclasses.fields(MotionLimits)
    }
    return MotionLimits(**(wide | changes))


@pytest.mark.parametrize("what", ["lower", "upper", "velocity", "acceleration", "jerk", "torque"])
def test_each_violation_names_joint_and_limit_and_nothing_else(what: str) -> None:
    model = arm_model(load_arm("planar2"))
    series = FourierSeries(0.1, np.full((2, 3), 0.2), np.full((2, 3), 0.1), np.zeros(2))
    tight = {"lower": np.array([-100.0, 0.0]), "upper": np.array([100.0, 0.0])}.get(what, np.array([1e6, 1e-3]))
    found = peak_bounds(once(series), model).violations(model.chain.names, limits_of(model, **{what: tight}))
    assert len(found) == 1
    assert found[0].startswith(f"elbow: {'position' if what in ('lower', 'upper') else what} ")


def test_all_violations_are_named_in_the_refusal() -> None:
    model = arm_model(load_arm("planar2"))
    series = FourierSeries(0.1, np.full((2, 3), 50.0), np.full((2, 3), 50.0), np.zeros(2))
    with pytest.raises(MotionRefused) as caught:
        require_within_limits(once(series), model, motion_limits(model.config))
    for joint in ("shoulder", "elbow"):
        for what in ("position", "velocity", "acceleration", "jerk", "torque"):
            assert f"{joint}: {what} " in str(caught.value)


@pytest.mark.parametrize("arm", MOVABLE)
@pytest.mark.parametrize("purpose", ["identification", "validation"])
def test_shipped_motions_stay_inside_the_limits(arm: str, purpose: Any) -> None:
    model = arm_model(load_arm(arm))
    motion = excitation(model, purpose)
    limits = motion_limits(model.config)
    assert peak_bounds(motion.path, model).violations(model.chain.names, limits, model.config.supply) == []
    position, velocity, *_ = motion.path.at(np.linspace(0.0, motion.duration, 2000))
    assert (position >= limits.lower).all()
    assert (position <= limits.upper).all()
    assert (np.abs(velocity) <= limits.velocity).all()
    assert (motion.name, motion.arm_sha256) == (purpose, model.config.motion_sha256)


@pytest.mark.slow
def test_the_two_motions_of_an_arm_differ() -> None:
    for arm in MOVABLE:
        model = arm_model(load_arm(arm))
        first, second = (series_of(model, purpose) for purpose in ("identification", "validation"))
        assert not np.allclose(first.at(1.0)[0], second.at(1.0)[0])


def seeded(seed: int, **changes: object) -> ArmConfig:
    """planar2 with another seeded motion."""
    config = load_arm("planar2").model_dump(by_alias=True)
    config["motions"]["identification"] |= {"seed": seed} | changes
    return ArmConfig.model_validate(config)


def test_seeded_motions_are_the_same_for_the_same_seed() -> None:
    first, again, other = (series_of(arm_model(seeded(seed)), "identification") for seed in (11, 11, 12))
    for name in ("a", "b", "q0"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not np.allclose(first.a, other.a)


@pytest.mark.slow
@some(12)
@given(
    seed=st.integers(0, 2**31),
    harmonics=st.integers(1, 10),
    frequency=st.floats(0.02, 1.0),
    use=st.floats(0.05, 0.9),
)
def test_seeded_motions_use_their_share_of_the_limits(seed: int, harmonics: int, frequency: float, use: float) -> None:
    config = seeded(seed, harmonics=harmonics, base_frequency=frequency, use=use)
    model = arm_model(config)
    limits = motion_limits(config)
    middle = 0.5 * (limits.lower + limits.upper)
    roomy = dataclasses.replace(limits, torque=limits.torque * 100)
    try:
        series = series_of(model, "identification")
    except MotionRefused as refusal:
        # Little use of the torque is not enough to carry the arm's own weight, and nothing else is refused.
        assert use < 0.32
        assert "gravity alone" in str(refusal)  # noqa: PT017
        return
    asked = peak_bounds(once(series), model)
    shares = np.array(
        [
            np.maximum(asked.highest - middle, middle - asked.lowest) / (limits.upper - middle),
            asked.velocity / limits.velocity,
            asked.acceleration / limits.acceleration,
            asked.jerk / limits.jerk,
        ]
    )
    assert (shares <= use * (1.0 + 1e-9)).all()
    assert asked.torque is not None
    assert (asked.torque <= use * limits.torque).all()
    assert asked.violations(model.chain.names, roomy) == []


def test_an_arm_too_weak_for_its_own_weight_is_reported() -> None:
    config = load_arm("planar2").model_dump(by_alias=True)
    config["joints"]["shoulder"]["torque"] = 1.0
    with pytest.raises(MotionRefused, match="gravity alone asks for more than 70%"):
        excitation(arm_model(ArmConfig.model_validate(config)), "identification")


def test_a_published_motion_beyond_the_limits_is_refused() -> None:
    config = load_arm("wam7").model_dump(by_alias=True)
    config["joints"]["j2"]["velocity"] = 0.5
    with pytest.raises(MotionRefused, match="j2: velocity"):
        excitation(arm_model(ArmConfig.model_validate(config)), "identification")


def test_missing_limits_are_refused_and_every_gap_is_named(tmp_path: Path) -> None:
    text = Path(shipped_arms()["planar2"]).read_text(encoding="utf-8")
    text = text.replace(", jerk: 80", "").replace(", kp: 400, kd: 40", "")
    (tmp_path / "gaps.yaml").write_text(text)
    with pytest.raises(MotionRefused) as caught:
        excitation(arm_model(load_arm(tmp_path / "gaps.yaml")), "identification")
    named = str(caught.value).split("needs ")[1].split(", ")
    assert named == [
        "joints.shoulder.jerk",
        "joints.shoulder.kp",
        "joints.shoulder.kd",
        "joints.elbow.kp",
        "joints.elbow.kd",
    ]


def test_an_arm_without_joint_limits_is_refused() -> None:
    config = load_arm("planar2").model_dump(by_alias=True) | {"joints": {}}
    with pytest.raises(MotionRefused, match="limits for every joint"):
        excitation(arm_model(ArmConfig.model_validate(config)), "identification")
