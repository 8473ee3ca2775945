"""`ident preflight --scale`: positions against angles by which a person has turned each joint."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.arm import Arm, ArmDescription, Sample, StopKind, Vector
from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.errors import UsageError
from ident_service.motion.arm_factory import make_arm
from ident_service.operations.arm_checks import FILE, check_scale

CONFIG = load_arm("planar2")


class Handled(Arm):
    """An arm whose joints a person turns, and whose encoders count with a scale of their own."""

    def __init__(self, scale: Vector) -> None:
        self.inner = make_arm(CONFIG)
        self.clock = self.inner.clock
        self.turned, self.scale = np.zeros(2), scale

    def open(self) -> None:
        self.inner.open()

    def describe(self) -> ArmDescription:
        return self.inner.describe()

    def enable(self) -> None:
        pytest.fail("a check of the scale energised the arm")

    def reset(self) -> None:
        pytest.fail("a check of the scale reset drives")

    def exchange(self, torque: Vector | None) -> Sample:
        assert torque is None
        sample = self.inner.exchange(None)
        return replace(sample, position=sample.position + self.scale * self.turned)

    def stop(self, kind: StopKind) -> None:
        self.inner.stop(kind)

    def close(self) -> None:
        self.inner.close()


def person(arm: Handled, *degrees: float | None) -> Callable[[str], str]:
    """Turns each joint by so much and says so; None leaves a joint out."""
    joints = iter(range(2))

    def turn(question: str) -> str:
        joint = next(joints)
        assert question.startswith(("shoulder", "elbow")[joint])
        if (angle := degrees[joint]) is None:
            return " "
        arm.turned[joint] = math.radians(angle)
        return f"{angle:g}"

    return turn


def test_what_a_hand_turned_is_what_the_drives_see_and_is_kept(tmp_path: Path) -> None:
    arm = Handled(np.ones(2))
    found = check_scale(CONFIG, tmp_path, person(arm, 90.0, -45.0), arm)
    assert [(one.joint, one.good) for one in found] == [("shoulder", True), ("elbow", True)]
    assert found[1].measured == pytest.approx(-math.pi / 4.0, abs=1e-3)
    kept = json.loads((tmp_path / "arms" / "planar2" / FILE).read_text())
    assert kept["arm_sha256"] == CONFIG.sha256
    assert kept["joints"]["elbow"]["typed"] == pytest.approx(-math.pi / 4.0)


@pytest.mark.parametrize(
    ("scale", "words"),
    [(0.5, "transmission.ratios is 2 times too large"), (2.0, "transmission.ratios is 0.5 times too large"),
     (0.8, "the scale is wrong"), (-1.0, "the sign of transmission.ratios is wrong"), (0.0, "does not count")],
)  # fmt: skip
def test_a_wrong_scale_is_named_and_a_wrong_sign_distinguished_from_it(
    tmp_path: Path, scale: float, words: str
) -> None:
    arm = Handled(np.array([scale, 1.0]))
    shoulder, elbow = check_scale(CONFIG, tmp_path, person(arm, 90.0, 60.0), arm)
    assert (shoulder.good, elbow.good) == (False, True)
    assert words in shoulder.words


def test_a_joint_that_is_left_out_keeps_what_was_found_of_it_earlier(tmp_path: Path) -> None:
    first = Handled(np.array([0.5, 1.0]))
    check_scale(CONFIG, tmp_path, person(first, 90.0, 60.0), first)
    second = Handled(np.ones(2))
    assert [one.joint for one in check_scale(CONFIG, tmp_path, person(second, 90.0, None), second)] == ["shoulder"]
    kept = json.loads((tmp_path / "arms" / "planar2" / FILE).read_text())["joints"]
    assert [kept[name]["good"] for name in ("shoulder", "elbow")] == [True, True]


@pytest.mark.parametrize("answer", ["a quarter", "5", "nan"])
def test_an_answer_that_tells_nothing_is_refused(tmp_path: Path, answer: str) -> None:
    arm = Handled(np.ones(2))
    with pytest.raises(UsageError, match="shoulder: "):
        check_scale(CONFIG, tmp_path, lambda question: answer, arm)
    assert not (tmp_path / "arms" / "planar2" / FILE).exists()


def test_nobody_is_asked_where_there_is_no_terminal(tmp_path: Path) -> None:
    assert main(["check", "planar2", "--scale", "--state", str(tmp_path)]) == 2
