"""How often a motion reaches its end on this computer, as it is: drives in another process, the machine's own clock.

`make bench-realtime`, or `python -m benchmarks.realtime [TRIES]`, about a minute a try: the WAM at 500 Hz as
`docs/fieldbus.md` has it, but lowered after a stop, as nobody is there to confirm that it is supported; planar2 behind
two drives at 1 kHz; and the same given positions at 250 Hz. `ident emulate`, `ident preflight`, then `ident run` again
and again (10 times). What stalls the machine meanwhile is in the figures.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from benchmarks.harness import Row, table, write
from ident_service.config.load import load_arm, shipped_arms
from ident_service.registry.state_folder import arm_fault_store

TRIES = 10
TARGET = "0.9"
_PATIENCE = {"torque_deadline": 0.05, "lost_cycles": 5}
_REALTIME = {"priority": 80}  # above whatever else of ours runs on this computer, such as tests


def wam(folder: Path) -> Path:
    """Write the arm of `docs/fieldbus.md`."""
    bus = {"interface": "ident_wire", "channel": f"wam{os.getpid()}"}
    driver = {"kind": "canopen", "buses": [bus], **_PATIENCE}
    tree = {"extends": "wam7_canopen_500hz", "name": "wam_here", "control": {"after_stop": "lower"}, "driver": driver}
    return _written(folder, tree | {"realtime": _REALTIME})


def planar(folder: Path, streams: str = "torque") -> Path:
    """Write planar2 behind two drives, that are given torques at 1 kHz or positions at 250 Hz; a motion takes 10 s."""
    shipped = shipped_arms()["planar2"]
    truth = yaml.safe_load(Path(shipped).read_text(encoding="utf-8"))["driver"]["truth"]
    motion = {"kind": "seeded", "seed": 1, "base_frequency": 0.2, "harmonics": 5, "periods": 2}
    positions = streams == "position"
    drive = {"counts": 65536, "rated_torque": 0.1, "max_torque": 3.0, "max_speed": 6000.0}
    driver = {
        "kind": "canopen",
        "streams": streams,
        "eds": str(Path(shipped).with_name("emulated_drive.eds")),
        "buses": [{"interface": "ident_wire", "channel": f"{streams}{os.getpid()}"}],
        "drives": [drive | {"node": 1}, drive | {"node": 2}],
        "emulation": {"seed": 1, "truth": truth},
        **_PATIENCE,
        "lost_cycles": 5 if positions else 10,  # 20 or 10 ms
    }
    return _written(
        folder,
        {
            "extends": "planar2",
            "name": "positions_here" if positions else "planar_here",
            "control": {"rate": 250.0 if positions else 1000.0},
            "realtime": _REALTIME,
            "transmission": {"ratios": [20.0, 20.0]},
            "motions": {"identification": motion, "validation": motion},
            "driver": driver,
        },
    )


def measure(path: Path, tries: int, state: Path) -> list[Row]:
    """Check an arm, then move it again and again.

    Args:
        path: of its description.
        tries: how often.
        state: folder of tickets and faults.

    Raises:
        RuntimeError: preflight refuses the arm three times.
    """
    config = load_arm(path)
    name = f"{config.name} at {config.control.rate:g} Hz"
    place = state.parent / config.name
    for _ in range(3):
        with _emulated(path):
            checked = _ident("check", path, "--confirm", config.name, "--state", state)
        if checked.returncode == 0:
            break
        print(checked.stdout)
    else:
        raise RuntimeError(f"{name}: preflight refuses it: {checked.stdout}")
    done, worst_ms, lost, cycles, ends = 0, list[float](), 0, 0, Counter[str]()
    for number in range(tries):
        run = place / f"run{number}"
        with _emulated(path):
            _ident("run", path, "--out", run, "--state", state)
        ended: dict[str, Any] = {}
        if (run / "ended.json").is_file():
            ended = json.loads((run / "ended.json").read_text(encoding="utf-8"))
        faults = arm_fault_store(state, config.name)
        ends.update(["done"] if ended.get("state") == "done" else [f"{k}: {v}" for k, v in faults.latched().items()])
        for code in list(faults.latched()):
            _ident("ack", path, code, "--state", state)
        if ended.get("state") == "done":
            lateness = ended["lateness"]
            done += 1
            worst_ms.append(lateness["worst_us"] * 1e-3)
            lost, cycles = lost + lateness["late_or_lost"], cycles + lateness["count"]
    for end, count in ends.items():
        print(f"{name}: {count} times {end}")
    rows = [Row(f"{name}: share of {tries} tries that reached the end", done / tries, "", f">= {TARGET}")]
    if worst_ms:
        rows += [
            Row(f"{name}: longest stall that was survived", max(worst_ms), "ms"),
            Row(f"{name}: cycles late or lost, of those tries", 100.0 * lost / (cycles + lost), "%", "<= 5"),
        ]
    return rows


@contextmanager
def _emulated(path: Path) -> Iterator[None]:
    """Keep `ident emulate` running beside."""
    command = [sys.executable, "-m", "ident_service", "emulate", str(path)]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as drives:
        try:
            assert drives.stdout is not None  # noqa: S101 - asked for
            if not any("pre operational" in line for line in drives.stdout):
                raise RuntimeError("the emulated drives ended")
            yield
        finally:
            drives.terminate()


def _ident(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ident_service", *map(str, words)]
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300
    )


def _written(folder: Path, tree: dict[str, Any]) -> Path:
    path = folder / f"{tree['name']}.yaml"
    path.write_text(json.dumps(tree), encoding="utf-8")  # YAML without anchors
    return path


def main() -> None:
    """Measure all arms."""
    tries = int(sys.argv[1]) if len(sys.argv) > 1 else TRIES
    rows = list[Row]()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for made_arm in (wam, planar, partial(planar, streams="position")):
            rows += measure(made_arm(folder), tries, folder / "state")
    load = os.getloadavg()[1]
    rows.append(Row("load of this computer in the last five minutes, this included", load, ""))
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'realtime')}")


if __name__ == "__main__":
    main()
