"""Recordings and descriptions that cannot be right are told so, and nobody is given their parameters for use."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from real_data.conftest import Identified

from benchmarks.real_data import CASES, DATA, case_model
from ident_service.cli import main
from ident_service.config.arm import ArmConfig, Identification
from ident_service.config.load import load_arm
from ident_service.config.quantities import TextFile
from ident_service.errors import ConfigError, ModelError
from ident_service.estimation.identify import Estimate, identify
from ident_service.estimation.plausibility import torque_clipped
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.regressor import joint_regressor
from ident_service.operations.identification import unusable_because
from ident_service.operations.recordings import recording_quality
from ident_service.recordings.open import open_recording
from ident_service.recordings.recording import Block, Recording

pytestmark = [pytest.mark.usefixtures("shared")]

KUKA = next(case for case in CASES if case.arm == "kuka_lwr4")
Change = Callable[[np.ndarray, np.ndarray], None]


@dataclass
class Changed:
    """A recording whose samples went through wrong hands."""

    behind: Recording
    change: Change

    def __post_init__(self) -> None:
        self.path, self.joints, self.joint_names = self.behind.path, self.behind.joints, self.behind.joint_names
        self.torque_zero_order_hold, self.torn = self.behind.torque_zero_order_hold, False
        self.sha256 = self.behind.sha256

    def blocks(self, samples: int = 1 << 30) -> Iterator[Block]:
        stamp_ns, position, torque = (part.copy() for part in whole(self.behind))
        self.change(position, torque)
        yield Block(stamp_ns, position, torque)


_READ: dict[str, tuple[np.ndarray, ...]] = {}


def whole(recording: Recording) -> tuple[np.ndarray, ...]:
    """Read stamps, positions and torques of a recording, of each file once."""
    if recording.sha256 not in _READ:
        parts = list(recording.blocks())
        _READ[recording.sha256] = tuple(
            np.concatenate([getattr(one, name) for one in parts]) for name in ("stamp_ns", "position", "torque")
        )
    return _READ[recording.sha256]


def kuka(**changes: Any) -> ArmConfig:
    """Give the KUKA without what its description knows of identifying it."""
    return load_arm("kuka_lwr4").model_copy(update={"identification": Identification(), **changes})


def changed(change: Change, model: ArmModel) -> list[Changed]:
    """Return the recording to fit and the one to judge on."""
    return [
        Changed(open_recording(DATA / KUKA.folder / str(name), model.chain.names, fmt=model.config.recording), change)
        for name in (KUKA.fitted, KUKA.judged)
    ]


def objections(estimate: Estimate, recordings: list[Changed]) -> tuple[str, ...]:
    return unusable_because(estimate, [(one, recording_quality(one, estimate.model)) for one in recordings]).reasons


def nothing(position: np.ndarray, torque: np.ndarray) -> None:
    pass


def degrees(position: np.ndarray, torque: np.ndarray) -> None:
    position *= 180.0 / np.pi


def swapped(position: np.ndarray, torque: np.ndarray) -> None:
    position[:], torque[:] = torque.copy(), position.copy()


def two_joints(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:, [1, 2]] = torque[:, [2, 1]]


def negated(position: np.ndarray, torque: np.ndarray) -> None:
    torque *= -1.0


def one_negated(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:, 5] *= -1.0


def one_missing(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:, 2] = 0.0


def magnitudes(position: np.ndarray, torque: np.ndarray) -> None:
    np.abs(torque, out=torque)


def one_sided(position: np.ndarray, torque: np.ndarray) -> None:
    magnitudes(position, torque)
    torque += 0.1 * torque.max(axis=0)


def thousandfold(position: np.ndarray, torque: np.ndarray) -> None:
    torque *= 1000.0


def spike(position: np.ndarray, torque: np.ndarray) -> None:
    position[2000:2005, 3] += 0.3


@pytest.mark.slow
def test_a_spike_and_wrong_units_of_an_arm_without_limits() -> None:
    bare = arm_model(kuka(joints={}))
    sound = changed(nothing, bare)
    estimate = identify(bare, sound[:1], sound[1:])  # so that only the recordings speak
    assert objections(estimate, sound) == ()
    (spiked, *_), (large, *_), (turned, *_) = (
        objections(estimate, changed(one, bare)) for one in (spike, thousandfold, degrees)
    )
    assert "lwr_3_joint jumps by 0.3" in spiked
    assert "a torque of 3.94e+04 N m would hold" in large
    assert "are the positions in degrees?" in turned
    assert any("no joint's torque is ever negative" in one for one in objections(estimate, changed(magnitudes, bare)))
    assert not any("ever negative" in one for one in objections(estimate, changed(one_sided, bare)))
    # Formerly this was taken for an exchange of columns, or passed: six joints of seven were predicted.
    (missing,) = objections(estimate, changed(one_missing, bare))[:1]
    assert re.search(
        r"the torque of lwr_2_joint is always 0 although it moves from -1\.\d+ to .* rad: it was not", missing
    )


def doubled(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:, 1] *= 2.0


def late(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:, 2] = np.roll(torque[:, 2], 50)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            doubled,
            r"the torque of shoulder_lift_joint seems to have another unit or scale .* multiplied by about 0\.48",
        ),
        (late, r"the torque of elbow_joint seems to be stamped about 0\.\d+ s too late"),
    ],
)
def test_a_column_of_another_scale_zero_or_time_than_the_others(change: Change, words: str) -> None:
    """Doubled, its error of 13 % was within what is usable, and a quarter of a turn off that of 6 %."""
    (case,) = (case for case in CASES if case.arm == "ur10")
    model = case_model(case)
    recording = open_recording(DATA / case.folder / case.fitted, model.chain.names, fmt=model.config.recording)
    wrong = Changed(recording, change)
    reason, *_ = objections(identify(model, [wrong], method="wls"), [wrong])
    assert re.search(words, reason)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ur10", "tx40"])
def test_torques_without_gravity_are_named(name: str, identified: Identified) -> None:
    """Torques less those of gravity are refused; their errors of 9 and 6 % were within what is usable."""
    (case,) = (case for case in CASES if case.arm == name)
    right = identified(name)
    chain, layout = right.model.chain, right.model.layout
    weightless = replace(chain, gravity=np.zeros(3))

    def compensated(position: np.ndarray, torque: np.ndarray) -> None:
        rest = np.zeros_like(position)
        held = joint_regressor(chain, layout, position, rest, rest)
        held -= joint_regressor(weightless, layout, position, rest, rest)
        torque -= np.einsum("jps,p->sj", held, right.delta)

    model = case_model(case)
    recording = open_recording(
        DATA / case.folder / case.fitted,
        chain.names,
        fmt=model.config.recording,
        transmission=model.config.transmission,
    )
    wrong = Changed(recording, compensated)
    reason, *_ = objections(identify(model, [wrong], method="wls"), [wrong])
    assert reason.startswith("the torques seem to lack gravity")


def clipped(position: np.ndarray, torque: np.ndarray) -> None:
    np.clip(torque, -20.0, 20.0, out=torque)


def averaged(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:, [1, 3]] = torque[:, [1, 3]].mean(axis=1)[:, None]


def hundredth(position: np.ndarray, torque: np.ndarray) -> None:
    torque *= 0.01


def tenfold(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:, 2] *= 10.0


def infinite(position: np.ndarray, torque: np.ndarray) -> None:
    torque *= 1e300


def backwards(position: np.ndarray, torque: np.ndarray) -> None:
    position[:], torque[:] = position[::-1].copy(), torque[::-1].copy()


def geared(position: np.ndarray, torque: np.ndarray) -> None:
    position[:, 1] *= 0.5


def turned_zero(position: np.ndarray, torque: np.ndarray) -> None:
    position[:, 1] += 0.5


def velocities(position: np.ndarray, torque: np.ndarray) -> None:
    position[:] = np.gradient(position, 0.005, axis=0)


def coarse(position: np.ndarray, torque: np.ndarray) -> None:
    position[:] = np.round(position / 0.05) * 0.05


def copied(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:] = torque[:, :1]


def reordered(position: np.ndarray, torque: np.ndarray) -> None:
    for columns in (position, torque):
        columns[:] = columns[:, ::-1].copy()


def wrapped(position: np.ndarray, torque: np.ndarray) -> None:
    position[:] = (position + np.pi / 2) % np.pi - np.pi / 2


def zeros_behind(position: np.ndarray, torque: np.ndarray) -> None:
    position[-100:], torque[-100:] = 0.0, 0.0


def noise(position: np.ndarray, torque: np.ndarray) -> None:
    torque[:, 1] = 20.0 * np.random.default_rng(0).normal(size=len(torque))


def shuffled(position: np.ndarray, torque: np.ndarray) -> None:
    order = np.random.default_rng(1).permutation(len(torque))
    position[:], torque[:] = position[order], torque[order]


def still(position: np.ndarray, torque: np.ndarray) -> None:
    position[:] = position[0] + 1e-5 * np.random.default_rng(0).normal(size=position.shape)


def far(position: np.ndarray, torque: np.ndarray) -> None:
    position[100, 2] = 3.4e38


@pytest.mark.slow
def test_torques_that_were_cut_off_are_told_and_those_of_a_drive_at_its_limit_are_not() -> None:
    """With 56 % of the samples of a joint at 20 N m, the torque error of 17 % was within what is usable."""
    model = arm_model(kuka().model_copy(update={"identification": Identification(method="ols", delay=0.0)}))
    recordings = changed(clipped, model)
    estimate = identify(model, recordings[:1])
    found = [(one, recording_quality(one, model)) for one in recordings[:1]]
    (reason,) = unusable_because(estimate, found).reasons
    assert re.search(
        r"the torque of lwr_1_joint stays at exactly -20 or 20 in 56 % of the samples while it moves, and its torque"
        r" error is \d\d %: it was cut off there; record it within the range of its sensor",
        reason,
    )
    assert any("joint lwr_1_joint: torque saturated in 56 %" in line for line in found[0][1].warnings())
    own = estimate.candidates[estimate.chosen]
    own = replace(own, moving=replace(own.moving, joint_relative_percent=np.full(7, 9.0)))
    predicted = replace(estimate, candidates=(*estimate.candidates[: estimate.chosen], own))
    assert torque_clipped(predicted, [found[0][1].joints]) == ()


# The KUKA in Craig's convention: a, alpha and d of each row are those before the joint.
CRAIG = ((0.0, 0.3105), ("pi/2", 0.0), ("-pi/2", 0.4), ("-pi/2", 0.0), ("pi/2", 0.39), ("pi/2", 0.0), ("-pi/2", 0.0))


def craig(convention: str) -> dict[str, Any]:
    rows = {f"lwr_{k}_joint": {"alpha": alpha, "d": d} for k, (alpha, d) in enumerate(CRAIG)}
    return {"dh": {"convention": convention, "joints": rows}}


@pytest.mark.slow
def test_sound_recordings_are_not_objected_to(identified: Identified) -> None:
    for case in CASES:
        model = arm_model(load_arm(case.arm))
        config = model.config
        assert config.identification == Identification()
        paths = [DATA / case.folder / name for name in (case.fitted, case.judged) if name]
        recordings = [
            open_recording(path, model.chain.names, fmt=config.recording, transmission=config.transmission)
            for path in paths
        ]
        estimate = identified(case.arm)
        assert unusable_because(estimate, [(one, recording_quality(one, model)) for one in recordings]).reasons == ()


@pytest.mark.slow
def test_two_axes_that_are_exchanged_are_named_although_one_of_them_is_off_by_little() -> None:
    """On the UR10 the torque of one is off by 5 %, that of the other by 25 %."""
    case = next(case for case in CASES if case.arm == "ur10")
    model = case_model(case)

    def exchanged(position: np.ndarray, torque: np.ndarray) -> None:
        for columns in (position, torque):
            columns[:, [3, 5]] = columns[:, [5, 3]]

    recording = open_recording(DATA / case.folder / case.fitted, model.chain.names, fmt=model.config.recording)
    wrong = Changed(recording, exchanged)
    (reason,) = objections(identify(model, [wrong], method="wls"), [wrong])
    assert "positions and torques of wrist_1_joint and wrist_3_joint seem to be exchanged" in reason


def written(folder: Path, change: Change, tree: dict[str, Any]) -> list[str]:
    """Write the recording to fit and the one to judge on, and a description; return the words that identify."""
    paths = []
    for wrong in changed(change, arm_model(load_arm("kuka_lwr4"))):
        lines = [",".join(["t", *(f"q{k}" for k in range(1, 8)), *(f"tau{k}" for k in range(1, 8))])]
        for block in wrong.blocks():
            table = np.column_stack([block.stamp_ns * 1e-9, block.position, block.torque])
            lines += [",".join(f"{value:.9g}" for value in row) for row in table]
        paths.append(folder / f"run{len(paths)}.csv")
        paths[-1].write_text("\n".join(lines) + "\n")
    arm = yaml.safe_load(Path("configs/kuka_lwr4.yaml").read_text())
    arm["kinematics"]["urdf"] = str(Path("configs/kuka_lwr4.urdf").resolve())
    (folder / "arm.yaml").write_text(yaml.safe_dump(arm | tree))
    fitted, unseen = map(str, paths)
    return ["identify", fitted, "--validate", unseen, "--arm", str(folder / "arm.yaml"), "--out", str(folder / "out")]


WRONG: dict[str, tuple[Change, dict[str, Any], str]] = {
    "degrees": (degrees, {}, "lwr_0_joint is recorded from -56.73 to 56.73 rad, .* degrees"),
    "q and tau": (swapped, {}, "lwr_1_joint is recorded from -38.05"),
    "two joints": (two_joints, {}, "the torques of lwr_1_joint and lwr_2_joint seem to be exchanged"),
    "sign": (negated, {}, "the torques of all joints seem to have the wrong sign"),
    "one sign": (one_negated, {}, "the torque, or the position, may have the wrong sign at lwr_5_joint"),
    "thousand": (thousandfold, {}, "the torque of lwr_1_joint reaches 3.936e.04, 224 times its limit of 176"),
    "spike": (
        spike,
        {},
        "lwr_3_joint moves 0.3.* rad between two samples, .* correct the samples 10.* s after",
    ),
    "cut off": (clipped, {}, "the torque of lwr_1_joint stays at exactly -20 or 20 in 56 %"),
    "averaged": (averaged, {}, "its torque error is 3.* more than 30 %"),
    "hundredth": (hundredth, {}, "no torque is ever more than 0.22 % of its joint's limit"),
    "tenfold": (tenfold, {}, "wrong sign at lwr_2_joint"),
    "backwards": (backwards, {}, "wrong sign"),
    "geared": (geared, {}, r"position of lwr_1_joint seems .* by about 1\.8"),
    "turned zero": (turned_zero, {}, "lwr_1_joint"),
    "velocities": (velocities, {}, "the torque, or the position, may have the wrong sign"),
    "coarse": (coarse, {}, "lwr_0_joint moves 0.05 rad between two samples"),
    "copied": (copied, {}, "more than 30 %"),
    "reordered": (reordered, {}, "more than 30 %"),
    "wrapped": (wrapped, {}, "lwr_2_joint moves 3.14 rad between two samples"),
    "zeros behind": (zeros_behind, {}, "lwr_0_joint moves 0.5 rad between two samples"),
    "noise": (noise, {}, "more than 30 %"),
    "no gravity": (nothing, {"gravity": [0, 0, 0]}, "more than 30 %"),
    "gravity of the moon": (nothing, {"gravity": [0, 0, -1.62]}, "without feasibility constraints: gravity"),
    "gravity": (
        nothing,
        {"gravity": [0.0, 0.0, 9.81]},
        "without feasibility constraints: gravity, signs, order or units",
    ),
    "convention": (
        nothing,
        {"kinematics": craig("standard")},
        r"^its torque error is [3-9]\d % where joints move on run1(.|\n)*DH convention",
    ),
}
SOUND = {"sound": {}, "Craig": {"kinematics": craig("modified")}}


@pytest.mark.campaign  # but for `test_the_command_says_no_where_people_look`
@pytest.mark.parametrize("name", WRONG)
def test_the_command_ends_with_3_for_what_cannot_be_right(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, tree, words = WRONG[name]
    assert main([*written(tmp_path, change, tree), "--json"]) == 3
    answer = json.loads(capsys.readouterr().out)
    assert answer["usable"] is False
    assert re.search(words, "\n".join(answer["unusable"]))
    assert (tmp_path / "out" / "report.txt").read_text().startswith("DO NOT USE")


@pytest.mark.campaign
@pytest.mark.parametrize("name", ["sound", "Craig"])
def test_the_command_objects_to_nothing_sound(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*written(tmp_path, nothing, SOUND[name]), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["unusable"] == []


@pytest.mark.slow
def test_the_command_says_no_where_people_look(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = written(tmp_path, negated, {"identification": {"method": "wls"}})
    assert main(words) == 3
    said = capsys.readouterr().out
    assert said.startswith("DO NOT USE these parameters:\n  - the torques of all joints seem to have the wrong sign")
    assert (tmp_path / "out" / "report.txt").read_text().startswith("DO NOT USE")
    page = (tmp_path / "out" / "report.html").read_text()
    assert ">Do not use: " in page
    assert "<li>the torques of all joints seem to have the wrong sign" in page
    content = json.loads((tmp_path / "out" / "parameters.json").read_text())
    assert "wrong sign" in content["unusable"][0]
    state = tmp_path / "state"
    assert main(["accept", str(tmp_path / "out"), "--note", "x", "--by", "me", "--state", str(state)]) != 0
    assert "must not be used" in capsys.readouterr().err


NO_RESULT: dict[str, tuple[Change, dict[str, Any], str]] = {
    "shuffled": (shuffled, {}, r"run0\.csv: lwr_0_joint moves .* rad between two samples, .* correct the samples"),
    "still": (still, {}, "no joint moves: each is slower than 0.005 rad/s or m/s over 20 ms; record a motion"),
    "gravity in millimetres": (
        nothing,
        {"gravity": [0, 0, -9810]},
        r"arm\.yaml:\d+:1: gravity: 9810 m/s\^2 is more than any planet has; in mm/s\^2\? gravity is \[0, 0, -9",
    ),
    "far": (far, {}, r"the position of lwr_2_joint reaches 3\.4e\+38, which no sensor measures"),
    "infinite": (infinite, {}, r"the torque of lwr_0_joint reaches 2\.\d+e\+300, which no sensor measures"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NO_RESULT)
def test_the_command_names_what_no_estimate_is_made_of(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """These ended with a wrong remedy: a longer recording, or weights that do not converge."""
    change, tree, words = NO_RESULT[name]
    assert main(written(tmp_path, change, tree)) == 2
    assert re.search(words, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


DH = {"joint": {"a": 0.3, "alpha": "90 deg"}}


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ({"a": 300.0}, "a: 300 m is longer than the link of any arm; in mm"),
        ({"d": -450.0}, "d: -450 m is longer"),
        ({"alpha": 90.0}, "alpha: 90 rad is more than a turn; numbers are rad, degrees are written '90 deg'"),
        ({"theta": -180}, "theta: -180 rad is more than a turn"),
    ],
)
def test_a_table_in_other_units(row: dict[str, Any], words: str, tmp_path: Path) -> None:
    tree = {"name": "arm", "kinematics": {"dh": {"convention": "standard", "joints": {"one": row}}}}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(tree))
    with pytest.raises(ConfigError, match=words):
        load_arm(tmp_path / "arm.yaml")


def test_a_urdf_in_millimetres() -> None:
    config = load_arm("kuka_lwr4")
    urdf = config.kinematics.urdf
    assert urdf is not None
    text = urdf.text.replace('xyz="0 0 0.2"', 'xyz="0 0 200"')
    assert text != urdf.text
    kinematics = config.kinematics.model_copy(update={"urdf": TextFile(name="kuka.urdf", text=text)})
    with pytest.raises(ModelError, match="more than 20 m from the joint before it; lengths are metres"):
        arm_model(config.model_copy(update={"kinematics": kinematics}))
