"""One minute for real: the simulated WAM, plant, motion and recorder in processes of their own, at 1 kHz.

What the machine's scheduler does is in the figures; a run that the guard stops because cycles come late says so.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from benchmarks.harness import Row, table, write
from ident_service.config.load import load_arm
from ident_service.errors import ArmFault
from ident_service.excitation.plan import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.factory import make_arm
from ident_service.motion.preflight import preflight
from ident_service.record.open import open_recording
from ident_service.service.run import run_motion

_DRIVER = "driver: {time: real, process: separate, status: %s, watchdog: 0.05, deadline: 1.0}"
_ON_TIME_US = 250.0  # a quarter of a period: what the guard counts as late


def measure(folder: Path) -> list[Row]:
    """Check the arm, run its identification motion, and hold the file against the report."""
    path = folder / "wam7_real.yaml"
    path.write_text(f"extends: wam7_sim\nname: wam7_real\n{_DRIVER % (folder / 'plant.status')}\n", encoding="utf-8")
    config = load_arm(path)
    model = arm_model(config)
    motion = excitation(model, "identification")
    ticket = preflight(make_arm(config), model, motion, confirm=lambda question: config.name)
    print(*(f"{check.code}: {check.verdict.value}" for check in ticket.checks), sep="\n")
    try:
        report: dict[str, Any] = run_motion(config, motion, folder / "run", folder / "state", ticket).report
    except ArmFault as fault:
        print(f"stopped: {fault}")
        sentence = "a minute at 1 kHz: cycles before the guard stopped it"
        return [Row(sentence, _samples(folder, model.chain.names), "")]
    found = _samples(folder, model.chain.names)
    print(report["real_time"], report["warnings"])
    name, lateness, compute = "a minute at 1 kHz", report["lateness"], report["compute"]
    late = sum(
        count for edge, count in zip(lateness["edges_us"], lateness["counts"][1:], strict=True) if edge >= _ON_TIME_US
    )
    return [
        Row(f"{name}: cycles recorded by the motion process", lateness["count"], ""),
        Row(f"{name}: of these not in the file", lateness["count"] - found, "samples", "0"),
        Row(f"{name}: woken more than {_ON_TIME_US:g} us late", late, "cycles"),
        Row(f"{name}: counted as late by the guard", report["warnings"].get("late_cycle", 0), "cycles"),
        Row(f"{name}: lateness, median below", lateness["median_below_us"], "us"),
        Row(f"{name}: lateness, 99.9 % below", lateness["p999_below_us"], "us"),
        Row(f"{name}: lateness, worst", lateness["worst_us"], "us"),
        Row(f"{name}: computing, median below", compute["median_below_us"], "us", "< 120"),
        Row(f"{name}: computing, 99.9 % below", compute["p999_below_us"], "us", "< 300"),
    ]


def _samples(folder: Path, names: tuple[str, ...]) -> int:
    """In the recording, finished or not."""
    (path,) = (folder / "run").glob("run.mcap*")
    return sum(len(block.stamp_ns) for block in open_recording(path, names).blocks())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        rows = measure(Path(made))
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'run')}")
