"""`ident view`: what it writes is read back by Rerun's own reader, and so is a recording."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.conftest import Commissioned, Ident
from scipy.spatial.transform import Rotation

from ident_service.config.kinematics import Kinematics
from ident_service.config.load import arm_from_json, load_arm
from ident_service.config.quantities import TextFile
from ident_service.errors import UsageError
from ident_service.model.appearance import visual_meshes
from ident_service.model.arm_model import arm_model
from ident_service.model.kinematics import joint_frames
from ident_service.model.pinocchio_models import read_urdf
from ident_service.recordings.open import open_recording
from ident_service.results.evidence.file import read_evidence
from ident_service.results.run_folder import write_manifest

STL = """solid one
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid one
"""
URDF = """<robot name="two">
<link name="base"/>
<link name="upper"><visual><origin xyz="0 0 0.1" rpy="1.5707963267948966 0 0"/>
<geometry><mesh filename="package://two_description/meshes/upper.stl" scale="0.1 0.2 0.3"/></geometry></visual></link>
<link name="flange"><visual><geometry><mesh filename="{flange}"/></geometry></visual></link>
<joint name="one" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
<joint name="bolted" type="fixed"><parent link="upper"/><child link="flange"/><origin xyz="0.5 0 0"/></joint>
</robot>
"""


def columns(path: Path) -> dict[str, dict[str, Any]]:
    """Per entity what was sent over time, by the last part of a component's name, and `time` [s]."""
    from rerun.chunk import RrdReader  # loads for most of a second

    found: dict[str, dict[str, Any]] = {}
    for chunk in RrdReader(path).stream():
        batch, entity = chunk.to_record_batch(), found.setdefault(str(chunk.entity_path), {})
        for name in batch.schema.names[1:]:
            values = batch.column(name)
            if name == "time":
                entity["time"] = np.array([one.value for one in values]) * 1e-9
            else:
                entity.setdefault(name.split(":")[1], values.to_pylist())
    return found


@pytest.fixture(scope="module")
def saved(quick: Commissioned, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    from ident_service.operations.run_view import show_run_in_viewer

    path = tmp_path_factory.mktemp("view") / "run.rrd"
    seen = show_run_in_viewer(quick.folder, save_file=path)
    assert seen.recordings == seen.residuals == ("identification", "validation")
    assert [one.name for one in path.parent.iterdir()] == ["run.rrd"]
    return columns(path)


@pytest.mark.slow
def test_the_arm_stands_where_its_joints_were_measured(quick: Commissioned, saved: dict[str, dict[str, Any]]) -> None:
    model = arm_model(arm_from_json(quick.folder / "arm.json"))
    blocks = list(open_recording(quick.folder / "validation.mcap", model.chain.names).blocks())
    stamps = np.concatenate([block.stamp_ns for block in blocks])
    position = np.concatenate([block.position for block in blocks])
    for k, joint in enumerate(model.chain.names):
        measured = saved[f"/validation/position/{joint}"]
        np.testing.assert_allclose(measured["time"], (stamps - stamps[0]) * 1e-9, atol=1e-9)
        np.testing.assert_array_equal(np.array(measured["scalars"])[:, 0], position[:, k])
        pose = saved[f"/validation/arm/{joint}"]
        rows = np.searchsorted((stamps - stamps[0]) * 1e-9, pose["time"] - 1e-9)
        assert len(rows) > 10
        turns, places = joint_frames(model.chain, position[rows])
        np.testing.assert_allclose(np.array(pose["translation"])[:, 0], places[:, k], atol=1e-6)
        read = Rotation.from_quat(np.array(pose["quaternion"])[:, 0]).as_matrix()
        np.testing.assert_allclose(read, turns[:, k], atol=1e-6)
        asked = saved[f"/validation/reference/{joint}"]
        assert np.abs(np.array(asked["scalars"])[:, 0] - position[:, k]).max() < 0.2
    solids = [path for path in saved if path.startswith("/validation/arm/") and "/solid_" in path]
    assert {path.split("/")[3] for path in solids} >= set(model.chain.names)


def test_residuals_are_those_of_the_report(quick: Commissioned, saved: dict[str, dict[str, Any]]) -> None:
    evidence = read_evidence(quick.folder / "evidence.json")
    for trace in evidence.recordings:
        for joint, expected in zip(evidence.joints, trace.joints, strict=True):
            shown = saved[f"/{Path(trace.name).stem}/residual/{joint}"]
            np.testing.assert_array_equal(np.array(shown["scalars"]), expected.residual.T)
            np.testing.assert_allclose(shown["time"], trace.time, atol=1e-9)
    told = [text for [text] in saved["/validation/events"]["text"]]
    assert "exciting" in told


def test_the_command_says_what_it_wrote(quick: Commissioned, ident: Ident, tmp_path: Path) -> None:
    # A motion that nothing was identified from: no residuals.
    run = tmp_path / "run"
    run.mkdir()
    for name in ("arm.json", "validation.mcap"):
        shutil.copy(quick.folder / name, run / name)
    write_manifest(run)
    seen = ident("view", run, "--save", tmp_path / "a.rrd")
    assert seen.code == 0
    assert "residuals: none; identify" in seen.out
    assert "rerun " in seen.out
    assert "/validation/position" in str(columns(tmp_path / "a.rrd"))


def test_what_cannot_be_shown_is_refused_before_anything_is_written(
    quick: Commissioned, ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken, new = tmp_path / "taken.rrd", tmp_path / "new.rrd"
    taken.write_text("mine")
    bare = tmp_path / "bare"
    bare.mkdir()
    shutil.copy(quick.folder / "arm.json", bare)
    same = quick.folder / "validation.mcap"
    for words, said in (
        ((quick.folder, "--save", taken), "exists already"),
        ((quick.folder, "--save", tmp_path / "no" / "new.rrd"), "there is no folder"),
        ((bare, "--save", new), "name one: --recording FILE"),
        ((tmp_path, "--save", new), "has no arm.json"),
        ((quick.arm, "--save", new), "is no folder"),
        ((quick.folder, "--recording", same, "--save", new), "two recordings are called 'validation'"),
        ((quick.folder, "--urdf", tmp_path / "no.urdf", "--save", new), "cannot be read"),
    ):
        refused = ident("view", *words)
        assert refused.code == 2, words
        assert said in refused.err
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "--save FILE.rrd" in ident("view", quick.folder).err
    assert taken.read_text() == "mine"
    assert sorted(tmp_path.iterdir()) == [bare, taken]


def test_meshes_are_drawn_where_the_urdf_puts_them(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "upper.stl").write_text(STL)
    (tmp_path / "flange.obj").write_text("v 0 0 0\n")
    file, kinematics = tmp_path / "two.urdf", Kinematics(urdf=TextFile(name="two.urdf", text=URDF))
    file.write_text(URDF.format(flange="flange.obj"))
    chain = read_urdf(TextFile(name="two", text=file.read_text()), (0.0, 0.0, -9.81))[0]
    upper, flange = visual_meshes(file, kinematics, chain)
    assert (upper.joint, flange.joint) == (0, 0)
    assert (upper.file, flange.file) == (tmp_path / "meshes" / "upper.stl", tmp_path / "flange.obj")
    np.testing.assert_allclose(upper.translation, [0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(upper.rotation @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(flange.translation, [0.5, 0, 0], atol=1e-12)
    assert upper.scale.tolist() == [0.1, 0.2, 0.3]
    outside = tmp_path.parent / "outside.stl"
    outside.write_text(STL)
    for name, said in (
        ("../outside.stl", "is not below"),
        (f"file://{outside}", "is not below"),
        ("two.urdf", "is no .dae"),
        ("", "is not below"),
    ):
        file.write_text(URDF.format(flange=name))
        with pytest.raises(UsageError, match=said):
            visual_meshes(file, kinematics, chain)


def test_another_arms_urdf_is_refused(tmp_path: Path) -> None:
    (tmp_path / "upper.stl").write_text(STL)
    file = tmp_path / "two.urdf"
    file.write_text(URDF.replace("package://two_description/meshes/", "").format(flange="upper.stl"))
    other = arm_model(load_arm("planar2")).chain
    with pytest.raises(UsageError, match="hangs on joint 'one', which the arm does not have"):
        visual_meshes(file, Kinematics(urdf=TextFile(name="two.urdf", text=URDF)), other)


def test_rerun_reads_the_recording_itself(quick: Commissioned) -> None:
    from rerun.chunk import McapReader

    rows: dict[str, int] = {}
    for chunk in McapReader(quick.folder / "validation.mcap").stream():
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + chunk.num_rows
    samples = sum(len(block.stamp_ns) for block in open_recording(quick.folder / "validation.mcap").blocks())
    for topic in ("/joint_states", "/joint_commands"):
        for field in ("position", "velocity", "effort"):
            assert rows[f"{topic}/{field}"] == samples
    assert any("visual_geometries" in entity for entity in rows)
