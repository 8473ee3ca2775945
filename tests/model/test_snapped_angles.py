"""Angles that are rounded in a URDF make base parameters that are none; it is told, and mended on request."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from ident_service.cli import main
from ident_service.config.kinematics import snap_angles
from ident_service.config.load import load_arm
from ident_service.errors import ConfigError
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters, remarks_on_angles

CONFIGS = Path(__file__).parents[2] / "configs"


def four_decimals(found: re.Match[str]) -> str:
    return f"{float(found[0]):.4f}"


@pytest.fixture
def exact(tmp_path: Path, wam7_data: Path) -> Path:
    """The WAM as a URDF."""
    (tmp_path / "wam.urdf").write_text((wam7_data / "wam7_cad.urdf").read_text())
    (tmp_path / "exact.yaml").write_text("format: ident-arm\nversion: 1\nname: wam\nkinematics: {urdf: wam.urdf}\n")
    return tmp_path / "exact.yaml"


@pytest.fixture
def rounded(exact: Path) -> Path:
    """The same with angles of four decimals."""
    text = (exact.parent / "wam.urdf").read_text()
    short = re.sub(r'rpy="[^"]*"', lambda found: re.sub(r"\d+\.\d{5,}", four_decimals, found[0]), text)
    assert short != text
    (exact.parent / "short.urdf").write_text(short)
    (exact.parent / "rounded.yaml").write_text(
        "format: ident-arm\nversion: 1\nname: wam\nkinematics: {urdf: short.urdf}\n"
    )
    return exact.parent / "rounded.yaml"


def base_of(path: Path) -> BaseParameters:
    model = arm_model(load_arm(path))
    return base_parameters(model.chain, model.layout)


def test_rounded_angles_are_reported_and_snapped(
    exact: Path, rounded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right, faint = base_of(exact), base_of(rounded)
    assert faint.size > right.size
    assert remarks_on_angles(right) == ()
    (said,) = remarks_on_angles(faint)
    assert f"{faint.size - right.size} of {faint.size} base parameters" in said
    assert "kinematics.snap: true" in said
    assert main(["base", str(rounded)]) == 0
    assert f"WARNING: {said}" in capsys.readouterr().out

    rounded.write_text("format: ident-arm\nversion: 1\nname: wam\nkinematics: {urdf: short.urdf, snap: true}\n")
    snapped_base = base_of(rounded)
    np.testing.assert_array_equal(snapped_base.base, right.base)
    np.testing.assert_allclose(snapped_base.K, right.K, rtol=0, atol=1e-9)


def test_what_is_no_multiple_stays() -> None:
    text = '<origin xyz="1.5708 0 0" rpy="1.5708 -3.14  0.3"/><origin rpy=\'0.785398 1e-5 1.5650\'/><a rpy="x 1 2"/>'
    assert snap_angles(text) == (
        f'<origin xyz="1.5708 0 0" rpy="{math.pi / 2!r} {-math.pi!r} 0.3"/>'
        f"<origin rpy='{math.pi / 4!r} 0.0 1.5650'/><a rpy=\"x 1 2\"/>"
    )
    assert snap_angles(snap_angles(text)) == snap_angles(text)


def test_snapping_is_of_a_urdf(tmp_path: Path) -> None:
    content = yaml.safe_load((CONFIGS / "planar2.yaml").read_text())
    content["kinematics"]["snap"] = True
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    with pytest.raises(ConfigError, match="snap is of urdf"):
        load_arm(tmp_path / "arm.yaml")
