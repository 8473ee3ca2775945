"""An arm of two emulated drives and a host on its bus."""

from __future__ import annotations

import pytest
from pucks_bench import Host, pucks_config

from ident_service.config.arm import ArmConfig


@pytest.fixture(scope="session")
def planar2(tmp_path_factory: pytest.TempPathFactory) -> ArmConfig:
    """The arm of `pucks_config`, which nobody can change."""
    return pucks_config(tmp_path_factory.mktemp("pucks"))


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
