"""Joints over time: what is in the drawing, what it says of the limits, how large it gets, what it refuses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from results.svg import Svg

from ident_service.errors import UsageError
from ident_service.results.motion_figures import QUANTITIES, MotionTraces, joints_over_time


def traces(joints: int = 3, samples: int = 500, **changes: Any) -> MotionTraces:
    """Sines of amplitude 1 whose limits are 2, in both directions."""
    time = np.linspace(0.0, 10.0, samples)
    wave = np.sin(2.0 * np.pi * 0.3 * time[:, None] + np.arange(joints))
    two = np.full(joints, 2.0)
    motion = MotionTraces(
        names=tuple(f"joint{k}" for k in range(joints)),
        time=time,
        position=wave,
        velocity=wave,
        acceleration=wave,
        torque=wave,
        lower=-two,
        upper=two,
        velocity_limit=two,
        acceleration_limit=two,
        torque_limit=two,
        units=("rad",) * joints,
        ramps=((0.0, 1.0), (9.0, 10.0)),
    )
    return replace(motion, **changes)


def test_structure() -> None:
    svg = Svg.of(joints_over_time(traces(), "A <motion>"))
    svg.require_sound()
    assert svg.title == "A <motion>"
    assert svg.description.startswith("3 joints (joint0, joint1, joint2) over 10 s: position, velocity, ")
    assert len(svg.all("polyline", "trace")) == 3 * 4
    assert len(svg.all("polyline")) == 3 * 4
    # One more of each in the legend.
    assert len(svg.all("line", "limit")) == 3 * 4 * 2 + 1
    assert len(svg.all("rect", "ramp")) == 3 * 4 * 2 + 1
    assert len(svg.all("rect", "frame")) == 3 * 4
    assert svg.words.count("50 %") == 12
    for words in ("position [rad]", "velocity [rad/s]", "acceleration [rad/s²]", "torque [N m]", "joint2", "time [s]"):
        assert words in svg.words


def test_equal_heights_are_equal_shares() -> None:
    svg = Svg.of(joints_over_time(traces(1)))
    # The first one belongs to the legend.
    limits = sorted({float(line.get("y1", "")) for line in svg.all("line", "limit")[1:]})
    (line, *_) = svg.points("polyline", "trace")
    assert line[:, 1].min() == pytest.approx(limits[0] + 0.25 * (limits[1] - limits[0]), abs=0.1)
    assert line[:, 1].max() == pytest.approx(limits[0] + 0.75 * (limits[1] - limits[0]), abs=0.1)


def test_what_is_not_given_is_not_drawn() -> None:
    motion = traces(2, acceleration=None, torque=None, upper=None, velocity_limit=np.array([np.inf, 4.0]), ramps=())
    svg = Svg.of(joints_over_time(motion))
    svg.require_sound()
    assert len(svg.all("polyline", "trace")) == 2 * 2
    # Two lower limits of position, two limits of one joint's velocity, one in the legend.
    assert len(svg.all("line", "limit")) == 2 + 2 + 1
    assert svg.all("rect", "ramp") == []
    assert "torque" not in " ".join([*svg.words, svg.description])
    assert [word for word in svg.words if "limit" in word and word != "limit"] == [
        "Share of the limit used, at most: velocity 25 % (joint1)",
        "one limit",
        "one limit",
        "no limit",
    ]
    bare = traces(1, lower=None, upper=None, velocity_limit=None, acceleration_limit=None, torque_limit=None)
    assert "No limits given" in Svg.of(joints_over_time(bare)).words


def test_limits_beyond_all_sense_are_none() -> None:
    # As some URDF files write "no limit".
    endless = np.full(1, 1e16)
    svg = Svg.of(joints_over_time(traces(1, lower=-endless, upper=endless, velocity_limit=np.full(1, 1e308))))
    assert svg.words.count("no limit") == 2


def test_shares() -> None:
    motion = traces(2, lower=np.array([0.0, -2.0]), upper=np.array([4.0, np.inf]), torque=None)
    # The middle is at 2, the lowest value at -1.
    np.testing.assert_allclose(motion.shares("position"), [1.5, np.nan], rtol=1e-3)
    np.testing.assert_allclose(motion.shares("velocity"), 0.5, rtol=1e-3)
    assert np.isnan(motion.shares("torque")).all()


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.0, "0 %"),
        (0.001, "< 1 %"),
        (0.5, "50 %"),
        (0.9999, "99 %"),
        (1.0, "100 %"),
        (1.0001, "101 % OVER"),
        (20.0, "2000 % OVER"),
    ],
)
def test_rounding_never_reaches_or_crosses_a_limit(share: float, words: str) -> None:
    motion = traces(1, velocity=np.linspace(0.0, 2.0 * share, 500)[:, None])
    svg = Svg.of(joints_over_time(motion))
    svg.require_sound()
    assert words in svg.words
    assert (len(svg.all("text", "warn")) == 1) is (share > 1.0)


def test_limits_lie_over_the_values_they_are_crossed_by() -> None:
    kinds = [element.get("class") for element in Svg.of(joints_over_time(traces(1))).root.iter()]
    assert kinds.index("limit", kinds.index("trace")) > kinds.index("trace")


def test_turning_and_sliding_joints() -> None:
    svg = Svg.of(joints_over_time(traces(2, units=("rad", "m"))))
    assert {"turns", "slides", "position [rad or m]", "torque [N m or N]"} <= set(svg.words)
    assert "acceleration [m/s²]" in Svg.of(joints_over_time(traces(1, units=("m",)))).words


def test_long_and_strange_names() -> None:
    names = ("left_shoulder_pan_joint_1", "<&\x00>", "")
    svg = Svg.of(joints_over_time(traces(3, names=names)))
    svg.require_sound()
    assert svg.all("text", "strong")
    assert "left_shoulder_pan_j…" in svg.words
    hints = [element[0].text for element in svg.all("text") if len(element)]
    assert hints == ["left_shoulder_pan_joint_1", "<&\ufffd>"]


@pytest.mark.parametrize("value", [0.0, 1e-12, 7.0, -1e11])
def test_joints_that_stand_still(value: float) -> None:
    still = np.full((500, 2), value)
    motion = traces(2, position=still, lower=None, upper=None, velocity=still, velocity_limit=None)
    Svg.of(joints_over_time(motion)).require_sound()


def test_a_minute_of_noise_at_a_kilohertz_is_small() -> None:
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(4, 60_000, 7))
    motion = traces(7, 60_000, **{name: noise[k] for k, name in enumerate(QUANTITIES)})
    text = joints_over_time(replace(motion, time=np.arange(60_000) * 1e-3))
    assert len(text.encode()) < 300_000
    Svg.of(text).require_sound()


@given(seed=st.integers(0, 2**32 - 1), spike=st.integers(0, 19_999), height=st.floats(3.0, 50.0))
@pytest.mark.slow
def test_no_spike_is_lost(seed: int, spike: int, height: float) -> None:
    values = np.random.default_rng(seed).uniform(-1.0, 1.0, (20_000, 1))
    values[spike] = height
    line = Svg.of(joints_over_time(traces(1, 20_000, velocity=values))).points("polyline", "trace")[1]
    assert len(line) <= 2 * 232 + 2
    top = line[:, 1].argmin()
    left, right = line[0, 0], line[-1, 0]
    assert line[top, 0] == pytest.approx(left + (right - left) * spike / 19_999, abs=0.06)
    assert (line[:, 1] == line[top, 1]).sum() == 1


def one_bad(value: float) -> np.ndarray:
    wave = np.zeros((500, 3))
    wave[77, 1] = value
    return wave


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"position": one_bad(np.nan)}, r"position: the value at \[77, 1\] is nan"),
        ({"torque": one_bad(np.inf)}, r"torque: the value at \[77, 1\] is inf"),
        ({"velocity": np.zeros((500, 2))}, r"velocity: its shape is \(500, 2\), not \(500, 3\)"),
        ({"time": np.zeros(0)}, "time: it is empty"),
        ({"time": np.zeros(1)}, "must hold two samples or more and increase"),
        ({"time": np.zeros(500)}, "must hold two samples or more and increase"),
        ({"time": np.full(500, np.nan)}, r"time: the value at \[0\] is nan"),
        ({"units": ("rad", "m")}, "3 joints need a unit each"),
        ({"units": ("rad", "m", "deg")}, "rad or m"),
        (dict.fromkeys(QUANTITIES), "there is no position, velocity, acceleration or torque"),
        ({"lower": np.array([0.0, np.nan, 0.0])}, r"lower: the value at \[1\] is nan"),
        ({"lower": np.full(3, 2.0)}, "a lower one below its upper one"),
        ({"torque_limit": np.zeros(3)}, "a limit must be above zero"),
        ({"torque_limit": np.ones(2)}, r"torque_limit: its shape is \(2,\), not \(3,\)"),
        ({"ramps": ((1.0, 1.0),)}, "a ramp begins before it ends"),
        ({"ramps": ((0.0, np.nan),)}, "a ramp begins before it ends"),
        ({"names": (), "units": ()}, r"its shape is \(500, 3\), not \(500, 0\)"),
    ],
)
def test_what_cannot_be_drawn(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=f"^cannot draw .*{message}"):
        traces(**changes)
