"""Viewers in three dimensions get the places of joints and the distances of bodies."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from daemon.conftest import Asked
from helpers.meshes import threelink

from ident_service.config.load import load_arm
from ident_service.daemon.routes.views import ViewAnswer
from ident_service.errors import UsageError
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.trajectory import FourierPath
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.collision import CollisionModel
from ident_service.operations.arm_view import MOST_SAMPLES, figure, view_at_rest, view_of_motion, view_of_recording
from ident_service.operations.run_archive import import_run
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter


@pytest.fixture(scope="module")
def wam() -> ArmModel:
    return arm_model(load_arm("wam7_sim"))


@pytest.mark.parametrize("speed", [1.0, 0.25])
@pytest.mark.parametrize("ramp", [0.0, 2.0])
def test_a_motion_begins_and_ends_at_home_and_never_jumps(
    wam: ArmModel, ramp: float, speed: float, tmp_path: Path
) -> None:
    motion = excitation(wam, "identification")
    assert isinstance(motion.path, FourierPath)
    motion = replace(motion, path=FourierPath(motion.path.series, 3, ramp))
    (tmp_path / "motion.json").write_text(motion.to_json())
    view = view_of_motion(wam.config, tmp_path / "motion.json", speed)
    time, position = np.array(view["time"]), np.array(view["position"]).T
    assert position.shape == (len(time), 7)
    assert len(time) <= MOST_SAMPLES
    assert (np.diff(time) > 0.0).all()
    home = [wam.config.joints[name].home for name in wam.chain.names]
    np.testing.assert_allclose(position[[0, -1]], [home, home], atol=1e-4)
    fastest = np.abs(motion.path.at(np.linspace(0.0, motion.duration, 5000))[1]).max(axis=0)
    steps = np.abs(np.diff(position, axis=0)) / np.diff(time)[:, None]
    assert (steps <= speed * np.maximum(1.02 * fastest, 2.0)).all()  # a jump would be faster than motion and limits
    assert [one["name"] for one in view["phases"]] == ["approach", "identification", "return"]
    # What is shown of the motion is the motion.
    begin = view["phases"][1]["begin"]
    shown = (time > begin) & (time < begin + (ramp + motion.path.series.period) / speed)
    expected = motion.path.at((time[shown] - begin) * speed)[0]
    np.testing.assert_allclose(position[shown], expected, atol=5e-3)
    assert any("the rest repeats" in note for note in view["notes"])


def test_distances_are_those_of_the_collision_check(wam: ArmModel) -> None:
    view = view_of_motion(wam.config, None)
    collision, told = CollisionModel(wam), view["clearance"]
    position = np.array(view["position"]).T[told["samples"]]
    distances = collision.distances(position)
    assert told["pairs"] == list(collision.pairs)
    for kind, outside in (("itself", False), ("surroundings", True)):
        chosen = [k for k, pair in enumerate(collision.pairs) if ("obstacle" in pair or "inside" in pair) is outside]
        np.testing.assert_allclose(told[kind]["distance"], distances[:, chosen].min(axis=1), atol=1e-3)
        assert set(told[kind]["pair"]) <= set(chosen)


def test_an_arm_without_bodies_has_sticks_and_says_why_there_are_no_distances() -> None:
    config = load_arm("planar2")
    bare = arm_model(config.model_copy(update={"geometry": {}, "workspace": type(config.workspace)()}))
    view = view_of_motion(bare.config, None)
    assert view["clearance"] is None
    assert any("distances are not known" in note for note in view["notes"])
    assert {solid["joint"] for solid in view["figure"]["bodies"]} >= {0, 1}
    assert view_at_rest(bare.config)["figure"] == figure(bare)


def test_a_motion_of_another_arm_is_refused(wam: ArmModel, tmp_path: Path) -> None:
    (tmp_path / "motion.json").write_text(excitation(wam, "identification").to_json())
    with pytest.raises(UsageError, match="a motion of 7 joints, but planar2 has 2"):
        view_of_motion(load_arm("planar2"), tmp_path / "motion.json")


def test_a_recording_is_thinned_and_keeps_its_ends(wam: ArmModel, tmp_path: Path) -> None:
    count, flags, age = 9_000, np.ones(7, bool), np.zeros(7, int)
    with RecordingWriter(tmp_path / "run.mcap", wam.chain.names, "<robot/>", 10**18) as writer:
        for k in range(count):
            q = np.full(7, 1e-4 * k)
            writer.sample(Cycle(5 + k * 10_000_000, q, None, q, q, q, k, 0, 0, flags, age, 0))
    view = view_of_recording(wam.config, tmp_path / "run.mcap")
    time, position = np.array(view["time"]), np.array(view["position"]).T
    assert len(time) == MOST_SAMPLES
    assert time[0] == 0.0
    assert time[-1] == pytest.approx(0.01 * (count - 1), abs=0.02)
    np.testing.assert_allclose(position, np.outer(1e-2 * time, np.ones(7)), atol=1e-4)


@pytest.mark.slow
def test_meshes_that_came_with_an_arm_are_drawn(daemon: Asked, viewer: str) -> None:
    text, urdf, meshes = threelink("crane")
    sent = {"description": text, "files": {"threelink.urdf": urdf}}
    assert daemon.post("/api/v1/arms", sent).json()["objections"] == []
    view = "/api/v1/arms/crane/view"
    assert daemon.get(view).json()["figure"]["meshes"] == []
    # The same description again, now with its meshes.
    coded = {name: b64encode(content).decode() for name, content in meshes.items()}
    again = daemon.post("/api/v1/arms", {**sent, "meshes": coded})
    assert (again.status_code, again.json()["objections"]) == (201, None), again.text
    told = ViewAnswer.model_validate(daemon.get(view).json())
    assert [(one.owner, one.joint, one.triangles) for one in told.figure.meshes] == [
        ("waist", 0, 12),
        ("shoulder", 1, 12),
        ("slide", 2, 24),
    ]
    assert told.notes == ["threelink.urdf: link 'base' has parts without a mesh; capsules are shown"]
    assert {one.joint for one in told.figure.bodies} == {-1, 0, 1, 2}  # distances are of these still
    daemon.as_token(viewer)
    for one in told.figure.meshes:
        answer = daemon.get(one.source)
        assert (answer.status_code, answer.headers["content-type"]) == (200, "application/octet-stream")
        corners = np.frombuffer(answer.content, "<f4").reshape(one.triangles, 3, 3)
        assert 0.01 < np.ptp(corners.reshape(-1, 3), axis=0).min() <= np.ptp(corners.reshape(-1, 3), axis=0).max() < 0.5
    place, _, sha256 = told.figure.meshes[0].source.removesuffix("/0").rpartition("/")
    for path, status in (
        (f"{place}/{sha256}/-1", 404),
        (f"{place}/{sha256}/drawn.json", 422),
        (f"{place}/{64 * 'a'}/0", 422),
        (f"{place}/..%2F..%2F{sha256}/0", 404),
        (f"/api/v1/arms/planar2/meshes/{sha256}/0", 404),
    ):
        assert daemon.get(path).status_code == status, path


def test_an_arm_is_not_stored_where_its_meshes_are_none(daemon: Asked) -> None:
    text, urdf, _ = threelink("crane")
    sent = {"description": text, "files": {"threelink.urdf": urdf}, "meshes": {"column.stl": "no base 64"}}
    answer = daemon.post("/api/v1/arms", sent)
    assert (answer.status_code, answer.json()["error"]["message"]) == (400, "'column.stl': its content is not base 64")
    for name in ("../column.stl", "a/b.stl", ".stl"):
        assert daemon.post("/api/v1/arms", {**sent, "meshes": {name: ""}}).status_code == 422
    assert daemon.get("/api/v1/arms/crane").status_code == 404


def test_answers_of_the_routes(daemon: Asked, wam: ArmModel, commissioned: Path) -> None:
    import_run(daemon.service.db, daemon.service.state, commissioned, "test")
    motion = excitation(wam, "validation").to_json()
    other = daemon.post("/api/v1/motions", {"arm": "wam7_sim", "motion": motion}).json()["id"]
    run = f"/api/v1/runs/{commissioned.name}/view"
    for path, samples in (
        ("/api/v1/arms/wam7_sim/view", 0),
        ("/api/v1/arms/tx40/view", 0),  # which has no limits, and so no motion
        ("/api/v1/arms/wam7_sim/view?motion=own&speed=0.5", 2),
        (f"/api/v1/arms/wam7_sim/view?motion={other}", 2),
        (run, 2),
        (f"{run}?name=validation.mcap", 2),
    ):
        for _ in range(2):  # computed, then kept
            answer = daemon.get(path)
            assert answer.status_code == 200, answer.text
            view = ViewAnswer.model_validate(answer.json())
            assert len(view.time) >= samples
            assert len(view.position) == (len(view.figure.joints) if samples else 0)
    full, half = (
        daemon.get(f"/api/v1/arms/wam7_sim/view?motion=own&speed={share}").json()["time"][-1] for share in (1, 0.5)
    )
    assert half == pytest.approx(2 * full, rel=1e-3)
    for path, status in (
        ("/api/v1/arms/nobody/view", 404),
        ("/api/v1/arms/planar2/view?motion=none", 404),
        (f"/api/v1/arms/planar2/view?motion={other}", 404),  # of another arm
        ("/api/v1/arms/tx40/view?motion=own", 409),
        ("/api/v1/arms/planar2/view?motion=own&speed=0", 422),
        ("/api/v1/runs/none/view", 404),
        (f"{run}?name=arm.json", 404),
        (f"{run}?name=..%2Farm.json", 422),
    ):
        answer = daemon.get(path)
        assert (answer.status_code, bool(answer.json()["error"]["message"])) == (status, True), path
