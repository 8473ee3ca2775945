"""A description as folders and recordings keep it: whole, and the same arm again."""

from __future__ import annotations

from pathlib import Path

import pytest

from ident_service.config.load import arm_from_json, load_arm, shipped_arms
from ident_service.errors import ConfigError, UsageError


@pytest.mark.parametrize("name", list(shipped_arms()))
def test_a_shipped_arm_is_read_back(tmp_path: Path, name: str) -> None:
    config = load_arm(name)
    (tmp_path / "arm.json").write_text(config.model_dump_json())
    read = arm_from_json(tmp_path / "arm.json")
    assert read == config
    assert read.sha256 == config.sha256


def test_what_is_no_description_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        arm_from_json(tmp_path / "arm.json")
    (tmp_path / "arm.json").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="Invalid JSON"):
        arm_from_json(tmp_path / "arm.json")
