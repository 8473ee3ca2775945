"""An arm of two emulated drives and a host on its bus."""

from __future__ import annotations

import pytest
from drives_bench import Host, drives_config

from ident_service.config.arm import ArmConfig


@pytest.fixture(scope="session")
def planar2(tmp_path_factory: pytest.TempPathFactory) -> ArmConfig:
    """The arm of `drives_config`, which nobody can change."""
    return drives_config(tmp_path_factory.mktemp("drives"))


@pytest.fixture
def host(planar2: ArmConfig) -> Host:
    """A host on the bus of planar2 behind a differential, nothing configured yet."""
    return Host.on(planar2)


@pytest.fixture
def enabled(host: Host) -> Host:
    """The same with the map of FIELDBUS.md 2.3 and a torque deadline of 10 ms, enabled."""
    host.configure(deadline=10)
    host.enable()
    host.heard.clear()
    return host
