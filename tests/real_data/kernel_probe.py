"""Identify in a process of its own what a parent compares: JSON of numbers, verdicts and a certificate's check.

Usage: kernel_probe.py ARM [RECORDING]; without a recording, the real arm of that name from its own.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from real_data.known_friction import with_known_friction
from threadpoolctl import threadpool_info

from benchmarks.real_data import CASES, case_estimate, case_model
from ident_service.config.load import load_arm
from ident_service.estimation.certificate import certify
from ident_service.estimation.identify import Estimate, identify
from ident_service.model.arm_model import arm_model
from ident_service.recordings.open import open_recording


def estimated(arm: str, recording: str | None) -> Estimate:
    if recording is None:
        (case,) = (case for case in CASES if case.arm == arm)
        return case_estimate(case, "wls", model=with_known_friction(case_model(case)))
    model = arm_model(load_arm(arm))
    return identify(model, [open_recording(Path(recording), model.chain.names)], method="wls")


def told(estimate: Estimate) -> dict[str, Any]:
    """Collect what a report prints of an estimate, and the result of checking its certificate."""
    assert estimate.delta is not None
    proof = certify(
        estimate.beta, estimate.base, estimate.conditions, estimate.delta, expressions=list(estimate.base.expressions)
    )
    return {
        "kernels": sorted(
            {library["architecture"] for library in threadpool_info() if "openblas" in library["prefix"]}
        ),
        "words": {
            "feasible": estimate.feasible,
            "pressing": sorted(estimate.tight),
            "verdicts": list(estimate.verdicts),
            "certificate": proof.verdict,
        },
        "numbers": {
            "base": estimate.beta.tolist(),
            "deviations": estimate.standard_deviations.tolist(),
            "links": estimate.delta.tolist(),
            "margin": [estimate.margin],
            "errors": [one.identification.relative_percent for one in estimate.candidates],
        },
    }


if __name__ == "__main__":
    print(json.dumps(told(estimated(*sys.argv[1:2], sys.argv[2] if len(sys.argv) > 2 else None))))
