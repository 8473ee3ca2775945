"""An arm of two emulated drives and a host on its bus."""

from __future__ import annotations

from pathlib import Path

import pytest
from pucks_bench import Host, pucks_config


@pytest.fixture
def host(tmp_path: Path) -> Host:
    """A host on the bus of planar2 behind a differential, nothing configured yet."""
    return Host.on(pucks_config(tmp_path))


@pytest.fixture
def enabled(host: Host) -> Host:
    """The same with the map of FIELDBUS.md 2.3 and a torque deadline of 10 ms, enabled."""
    host.configure(deadline=10)
    host.enable()
    host.heard.clear()
    return host
