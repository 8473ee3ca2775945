"""Meshes that a URDF names become triangles in the frames of joints, and nothing else is read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.meshes import FACES, box, stl, threelink

from ident_service.config.load import load_arm
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.arm_model import arm_model
from ident_service.model.chain import Array
from ident_service.model.drawn_meshes import coarsened, joint_triangles


def drawn(folder: Path, urdf: str) -> tuple[dict[int, Array], list[str]]:
    model = arm_model(load_arm("threelink"))
    named = TextFile(name="threelink.urdf", text=urdf)
    return joint_triangles(named, model.config.kinematics, model.chain, folder)


@pytest.fixture
def urdf(tmp_path: Path) -> str:
    _, urdf, meshes = threelink()
    for name, content in meshes.items():
        (tmp_path / name).write_bytes(content)
    return urdf


def test_each_kind_of_file_stands_in_its_joint(tmp_path: Path, urdf: str) -> None:
    found, left = drawn(tmp_path, urdf)
    assert sorted(found) == [0, 1, 2]
    assert left == ["threelink.urdf: link 'base' has parts without a mesh; capsules are shown"]
    c, s = np.cos(0.5), np.sin(0.5)
    turned = box(0.05, 0.04, 0.15) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [0.0, 0.0, 0.15]
    np.testing.assert_allclose(np.sort(found[0], axis=0), np.sort(turned, axis=0), atol=1e-7)
    np.testing.assert_allclose(np.ptp(found[1].reshape(-1, 3), axis=0), [0.24, 0.06, 0.06], atol=1e-7)
    # The tool is bolted to the boom: the same file twice, at two places of one joint.
    assert len(found[2]) == 2 * len(FACES)
    np.testing.assert_allclose(np.ptp(found[2][: len(FACES)].reshape(-1, 3), axis=0), [0.04, 0.04, 0.04], atol=1e-7)
    assert np.abs(found[2][: len(FACES)].mean(axis=(0, 1)) - found[2][len(FACES) :].mean(axis=(0, 1))).max() > 0.1


@pytest.mark.parametrize(
    ("instead", "said"),
    [
        ("arm.stl", "the mesh 'arm.stl' did not come with it"),
        ("../../arm.stl", "the mesh 'arm.stl' did not come with it"),
        ("/etc/hostname", "'hostname' is none of .dae, .obj, .stl"),
        ("arm.gltf", "'arm.gltf' is none of .dae, .obj, .stl"),
        ("nonsense.stl", "the mesh 'nonsense.stl' cannot be read"),
        ("", "'' is none of .dae, .obj, .stl"),
        ("arm.obj\" scale=\"1 nan 1", "the scale '1 nan 1' of a mesh is not three numbers"),
    ],
)  # fmt: skip
def test_a_link_without_its_mesh_keeps_its_capsules(tmp_path: Path, urdf: str, instead: str, said: str) -> None:
    (tmp_path / "nonsense.stl").write_bytes(b"solid nonsense\nfacet\n" + bytes(300))
    (tmp_path.parent / "arm.stl").write_bytes(stl(box(1.0, 1.0, 1.0)))  # beside the folder, not in it
    (tmp_path / "arm.gltf").write_text(external("arm.obj"))
    found, left = drawn(tmp_path, urdf.replace("../meshes/arm.obj", instead))
    assert sorted(found) == [0, 2]
    assert left[-1].startswith(f"threelink.urdf: link 'arm': {said}"), left


def external(name: str) -> str:
    """A glTF whose corners are the bytes of another file."""
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"uri": name, "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "max": [9, 9, 9], "min": [0, 0, 0]}
        ],
    }
    return json.dumps(document)


@pytest.mark.parametrize("kind", ["stl", "obj", "dae"])
def test_a_format_that_reads_other_files_is_not_taken_under_another_ending(
    tmp_path: Path, urdf: str, kind: str
) -> None:
    """A mesh comes from a stranger: a glTF's buffer may be any file, whose bytes would come back as triangles."""
    (tmp_path.parent / "secret").write_bytes(np.arange(9, dtype="<f4").tobytes())
    (tmp_path / f"arm.{kind}").write_text(external("../secret"))
    found, left = drawn(tmp_path, urdf.replace("../meshes/arm.obj", f"arm.{kind}"))
    assert 1 not in found
    assert f"the mesh 'arm.{kind}' cannot be read" in left[-1]


def test_a_file_that_is_no_urdf_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"threelink\.urdf"):
        drawn(tmp_path, "<robot")


def test_many_triangles_become_fewer_and_keep_their_shape() -> None:
    angle, height = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 200), np.linspace(0.0, 1.0, 200), indexing="ij")
    points = np.stack([np.cos(angle), np.sin(angle), height], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    fine = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)
    coarse = coarsened(fine, 5_000)
    assert 1_000 < len(coarse) <= 5_000
    flat = coarse.reshape(-1, 3)
    np.testing.assert_allclose([flat.min(axis=0), flat.max(axis=0)], [[-1, -1, 0], [1, 1, 1]], atol=0.05)
    np.testing.assert_allclose(np.hypot(flat[:, 0], flat[:, 1]), 1.0, atol=0.1)
    np.testing.assert_array_equal(coarsened(fine, len(fine)), fine)
    assert len(coarsened(np.zeros((10, 3, 3)), 5)) == 5  # of a point
