"""Follow a run's recording in a process of its own, at the lowest priority, until its accuracy target is reached.

It reads one JSON object from standard input and prints one line of JSON, once. It reads what the recorder has flushed
and touches nothing else: its parent keeps the lease and asks for the finish. It ends when its standard input ends.
"""

from __future__ import annotations

import json
import os
import select
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ident_service.config.load import arm_from_json
from ident_service.estimation.online import SequentialLeastSquares
from ident_service.estimation.target import LEAST_BLOCKS, Target, worst_relative_deviation
from ident_service.estimation.uncertainty import relative_deviations
from ident_service.model.arm_model import arm_model
from ident_service.recordings.mcap_follower import RecordingFollower
from ident_service.recordings.open import open_recording
from ident_service.recordings.recording import Block

_LOOK = 0.3  # s between polls
_IN_A_ROW = 2  # consecutive steps below the target: deviations are estimates, and may dip below it once by chance


def main() -> int:
    """Read a request from stdin, follow the run's recording, and print one JSON line if the target is reached."""
    os.nice(19)
    request = json.loads(sys.stdin.readline())
    if said := watch(Path(request["folder"]), Target(request["share"], tuple(request["parameters"])), request["least"]):
        print(json.dumps(said), flush=True)
    return 0


def watch(folder: Path, target: Target, least_seconds: float) -> dict[str, Any] | None:
    """Follow a run's recording until the target is reached; return `seconds` and `share` then, None if it ends before.

    Args:
        folder: of the run.
        target: accuracy target.
        least_seconds: time of the motion before which nothing counts [s]: its period, zero where it has none.

    Raises:
        IdentError: the recording or the description cannot be read.
    """
    model = arm_model(arm_from_json(folder / "arm.json"))
    growing = SequentialLeastSquares(model, in_blocks=True, period=least_seconds)
    places = target.base_indices(growing.base, model.config.name)
    if (tail := _opened(folder)) is None:
        return None
    row = 0
    while True:
        samples = tail.read()
        if samples is not None:
            growing.add(Block(samples.stamp_ns, samples.position, samples.torque))
        elif tail.ended or _parent_is_gone():
            return None
        if not growing.step() or tail.exciting_ns is None or (doubt := growing.uncertainty()) is None:
            continue
        seconds = (doubt.until_ns - tail.exciting_ns) * 1e-9
        worst = worst_relative_deviation(doubt, places)
        row = row + 1 if seconds >= least_seconds and worst <= target.share else 0
        if row >= _IN_A_ROW:
            return {"seconds": round(seconds, 3), "share": worst}


def missed(folder: Path, target: Target, period: float) -> list[dict[str, Any]]:
    """List `parameter` and `share` of the chosen parameters whose deviation a run's recording leaves above the target.

    Args:
        folder: folder of the run, which is over.
        target: accuracy target that was not reached on the way.
        period: of the motion [s]; zero where it has none.

    Returns:
        Expression and share of each, the least known first; the share is None where the recording says nothing of it.

    Raises:
        IdentError: the recording or the description cannot be read.
    """
    model = arm_model(arm_from_json(folder / "arm.json"))
    growing = SequentialLeastSquares(model, in_blocks=True, period=period)
    for block in open_recording(folder / "run.mcap", model.chain.names).blocks():
        growing.add(block)
        while growing.step():
            pass
    places, doubt = target.base_indices(growing.base, model.config.name), growing.uncertainty()
    if doubt is None or doubt.blocks < LEAST_BLOCKS:
        known = np.full(len(places), np.inf)
    else:
        known = relative_deviations(doubt.beta, doubt.deviations, doubt.negligible)[places]
    found = [
        (growing.base.expressions[place], float(share))
        for place, share in zip(places.tolist(), known, strict=True)
        if not share <= target.share
    ]
    found.sort(key=lambda one: -one[1] if np.isfinite(one[1]) else -np.inf)
    return [{"parameter": name, "share": share if np.isfinite(share) else None} for name, share in found]


def _opened(folder: Path) -> RecordingFollower | None:
    """Return the recording as soon as there is one; None where nobody waits for it any more."""
    while True:
        for name in ("run.mcap.partial", "run.mcap"):
            try:
                return RecordingFollower(folder / name)
            except FileNotFoundError:
                continue
        if _parent_is_gone():
            return None


def _parent_is_gone() -> bool:
    """Wait a little; return whether standard input has ended, or has data, so that nobody waits for the answer."""
    return bool(select.select([sys.stdin.fileno()], [], [], _LOOK)[0])


if __name__ == "__main__":
    sys.exit(main())
