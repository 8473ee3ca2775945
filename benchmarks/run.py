"""One minute for real: the simulated WAM, plant, motion and recorder in processes of their own, as fast as they can.

What the machine's scheduler does is in the figures: where the guard stops a run because cycles come late, the next
lower rate is tried.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from benchmarks.harness import Row, table, write
from ident_service.config.load import load_arm
from ident_service.errors import ArmFault, MotionRefused
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.operations.motion_run import run_motion
from ident_service.preflight.preflight import preflight
from ident_service.recordings.open import open_recording

_DRIVER = "driver: {time: real, process: separate, status: %s, watchdog: 0.05, deadline: 1.0}"
_RATES = (1000, 500, 250)


def measure(folder: Path) -> list[Row]:
    """From rate to rate, until a run reaches its end."""
    rows: list[Row] = []
    for rate in _RATES:
        place = folder / str(rate)
        place.mkdir()
        more, done = _measured(place, rate)
        rows += more
        if done:
            break
    return rows


def _measured(folder: Path, rate: int) -> tuple[list[Row], bool]:
    """Check the arm, run its identification motion, and hold the file against the report; whether it was done."""
    path = folder / "wam7_real.yaml"
    driver = _DRIVER % (folder / "plant.status")
    path.write_text(f"extends: wam7_sim\nname: wam7_real\ncontrol: {{rate: {rate}}}\n{driver}\n", encoding="utf-8")
    config = load_arm(path)
    model = arm_model(config)
    motion = excitation(model, "identification")
    ticket = preflight(make_arm(config), model, motion, confirm=lambda question: config.name)
    print(*(f"{check.code}: {check.verdict.value}" for check in ticket.checks), sep="\n")
    try:
        report: dict[str, Any] = run_motion(config, motion, folder / "run", folder / "state", ticket).report
    except ArmFault as fault:
        print(f"stopped: {fault}")
        sentence = f"a minute at {rate} Hz: cycles before the guard stopped it ({fault.code})"
        return [Row(sentence, _samples(folder, model.chain.names), "")], False
    except MotionRefused as refusal:
        print(f"refused: {refusal}")
        return [Row(f"a minute at {rate} Hz: cycles, preflight having refused", 0, "")], False
    found = _samples(folder, model.chain.names)
    print(report["real_time"], report["warnings"])
    name, lateness, compute = f"a minute at {rate} Hz", report["lateness"], report["compute"]
    return [
        Row(f"{name}: cycles recorded by the motion process", lateness["count"], ""),
        Row(f"{name}: of these not in the file", lateness["count"] - found, "samples", "0"),
        Row(
            f"{name}: counted as late by the guard, a quarter of a period", report["warnings"].get("late_cycle", 0), ""
        ),
        Row(f"{name}: lateness, median below", lateness["median_below_us"], "us"),
        Row(f"{name}: lateness, 99.9 % below", lateness["p999_below_us"], "us"),
        Row(f"{name}: lateness, worst", lateness["worst_us"], "us"),
        Row(f"{name}: computing, median below", compute["median_below_us"], "us", "< 120"),
        Row(f"{name}: computing, 99.9 % below", compute["p999_below_us"], "us", "< 300"),
    ], True


def _samples(folder: Path, names: tuple[str, ...]) -> int:
    """In the recording, finished or not."""
    (path,) = (folder / "run").glob("run.mcap*")
    return sum(len(block.stamp_ns) for block in open_recording(path, names).blocks())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        rows = measure(Path(made))
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'run')}")
