"""What the cyclic plane of the CANopen driver computes in one cycle of the WAM, without a bus.

Joint torques to counts, counts to two torque frames; seven positions from bytes to joints; the torque really sent.
"""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import Row, table, write
from drivers.can.bus_load import exact_bits
from drivers.can.can_frame import Frame
from drivers.canopen.motor_units import coordinates
from drivers.canopen.pdo_codec import BusCodec
from drivers.canopen.pdo_mapping import bus_profiles
from drivers.motor_units import unwrapped
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.config.load import load_arm

CYCLES, WARM_UP = 20_000, 1_000


def measure(config: ArmConfig) -> list[Row]:
    """Computing time of this thread, whatever else the machine does meanwhile."""
    assert isinstance(config.driver, CanopenDriver)  # noqa: S101  # the shipped arm's is
    assert config.transmission is not None  # noqa: S101
    (profile,) = bus_profiles(config.driver, config.control.rate)
    codec, gears = BusCodec(profile), coordinates(config.driver, config.transmission)
    draw = np.random.default_rng(1)
    torques = draw.normal(0.0, 0.2, (CYCLES, len(profile.nodes))) * gears.torque_limit
    replies = [
        [Frame(0x180 + node, struct.pack("<i", counts)) for node, counts in zip(profile.nodes, row, strict=True)]
        for row in draw.integers(-40_000, 40_000, (CYCLES, len(profile.nodes))).tolist()
    ]
    clock, spent, before = time.thread_time_ns, np.zeros((CYCLES, 3)), [0] * len(profile.nodes)
    for cycle in range(CYCLES):
        begin = clock()
        counts, _ = gears.torque_counts(torques[cycle])
        geared = clock()
        codec.torque_frames(counts)
        codec.sync_frame()
        codec.begin_cycle(cycle)
        for reply in replies[cycle]:
            codec.receive(reply)
        codec.end_cycle()
        coded = clock()
        before = [unwrapped(was, drive.position) for was, drive in zip(before, codec.drives, strict=True)]
        gears.positions(before)
        gears.joint_torque(counts)
        end = clock()
        spent[cycle] = coded - geared, end - coded + geared - begin, end - begin
    rows = []
    for name, times in zip(("codec", "joints to counts and back", "both"), spent.T, strict=True):
        kept = times[WARM_UP:] * 1e-3
        target = "<< 100" if name == "codec" else None
        rows.append(Row(f"{name}, two torque frames and seven positions, median", float(np.median(kept)), "us", target))
        rows.append(Row(f"{name}, 99.9 %", float(np.quantile(kept, 0.999)), "us"))
    begin = clock()
    for row in replies[:WARM_UP]:
        for reply in row:
            exact_bits(reply)
    rows.append(Row("exact length of a frame, mean", (clock() - begin) / (7e3 * WARM_UP), "us"))
    return rows


def main() -> None:
    rows = measure(load_arm("wam7_canopen"))
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'fieldbus')}")


if __name__ == "__main__":
    main()
