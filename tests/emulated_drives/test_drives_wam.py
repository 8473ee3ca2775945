"""The WAM's seven drives, two differentials and all, emulated: held against gravity by whole per mille."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from drives_bench import CONFIGS, Host, drives_config
from test_drives_body import WAM

from drivers.can.can_link import open_links

RATED = 0.1  # N m at the motor, so that a count is 0.1 mN m


@pytest.mark.slow
def test_the_wam_stands_under_its_own_gravity_torque(tmp_path: Path) -> None:
    gears = {"ratios": list(WAM.ratios), "coupling": [list(row) for row in WAM.coupling or ()], "drive_terms": "joints"}
    drives = [{"node": k, "rated_torque": 1.0, "max_torque": 8.0, "max_speed": 6000.0} for k in range(1, 8)]
    truth = {"truth": str(CONFIGS / "wam7_truth.json")}
    config = drives_config(tmp_path, name="wam7.yaml", gears=gears, drives=drives, emulation=truth)
    (link,) = open_links(config)
    host = Host(link, tuple(range(1, 8)))
    for node in host.nodes:
        first, size = (0x201, 4) if node <= 4 else (0x205, 3)
        slots = [0x00030010] * size
        slots[(node - 1) % 4] = 0x60710010
        host.map_pdo(node, 0x1400, first, 1, slots, deadline=10)
        host.map_pdo(node, 0x1401, 0x300 + node, 255, [0x60400010, 0x60600008])
        assert host.write(node, 0x1402, 1, "I", 1 << 31 | 0x400 + node) == 0
        host.map_pdo(node, 0x1800, 0x180 + node, 1, [0x60640020])
        assert host.write(node, 0x1801, 1, "I", 1 << 31 | 0x280 + node) == 0
        assert host.write(node, 0x6072, 0, "H", 30000) == 0
        assert host.write(node, 0x6076, 0, "I", round(1000 * RATED)) == 0
    host.send(0x000, b"\x01\x00")
    body = host.arm.emulator.body
    start = body.plant.position
    at_rest = np.zeros(7)
    gravity = body.plant.inverse_dynamics(start, at_rest, at_rest)
    counts = np.rint(np.linalg.solve(body.gears.matrix.T, gravity) * 1000 / RATED).astype(int)

    def frames() -> None:
        host.send(0x201, struct.pack("<4h", *counts[:4]))
        host.send(0x205, struct.pack("<3h", *counts[4:]))

    frames()
    host.send(0x080)
    for word in (0x06, 0x07, 0x0F):
        host.control(word)
    host.listen(5)  # until the wire is free again
    truths = host.truths()
    shown = []
    for _ in range(1000):
        frames()
        shown.append(host.cycle())
    assert all(len(positions) == 7 for positions in shown)
    assert truths[-1].torque == pytest.approx(gravity, abs=0.01)
    # Dry friction holds what rounding leaves; a sign or a gear taken wrongly would be metres.
    assert body.plant.position == pytest.approx(start, abs=0.02)
    assert np.abs(gravity).max() > 1.0
