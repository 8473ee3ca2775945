"""Real recordings: what each estimate reaches on recordings it was not fitted to, joint by joint.

Read in place from `shared/data` beside the checkout, written as tables to `docs/real-data.md`.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np

from benchmarks.harness import Row, cpu_seconds
from ident_service.config.arm import Method, PriorRegularisation
from ident_service.config.load import load_arm
from ident_service.config.quantities import TextFile
from ident_service.errors import ParameterError
from ident_service.estimation.identify import Candidate, Estimate, identify
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.recordings.cached_recording import CachedRecording
from ident_service.recordings.open import open_recording

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@dataclass(frozen=True)
class Case:
    """One arm's recordings; without a validation recording, errors are on the recording fitted to."""

    arm: str
    folder: str
    fitted: str
    judged: str | None
    target: float
    urdf: str | None = None  # whose inertias are the prior


CASES = (
    Case("kuka_lwr4", "kuka_lwr4", "recording_1.csv.gz", "recording_2.csv.gz", 2.3, "kuka_lwr4.urdf"),
    Case("ur10", "ur10_unisa", "ident.csv.gz", "valid.csv.gz", 6.1, "ur10.urdf"),
    Case("tx40", "tx40", "run.csv.gz", None, 4.5, "tx40.urdf"),
)


def case_model(case: Case) -> ArmModel:
    """The arm of a case, with the inertias of the data's URDF as prior where they are those of real links."""
    model = arm_model(load_arm(case.arm))
    if case.urdf is None:
        return model
    from ident_service.model.pinocchio_models import read_urdf

    text = (DATA / case.folder / case.urdf).read_text(encoding="utf-8")
    chain, inertias = read_urdf(TextFile(name=case.urdf, text=text), model.config.gravity)
    if chain.names != model.chain.names or not np.all(inertias[:, 9] > 0.0):
        return model
    prior = np.zeros(model.layout.size)
    for link in range(model.layout.joints):
        prior[model.layout.inertial(link)] = inertias[link]
    return replace(model, prior=prior)


def case_estimate(case: Case, method: Method | None, prior: str = "none", model: ArmModel | None = None) -> Estimate:
    """Identify a case, by the method that the recordings choose when None."""
    model = model or case_model(case)
    pull = PriorRegularisation(kind=prior)  # type: ignore[arg-type]  # a literal by the callers below
    options = model.config.identification.model_copy(update={"prior": pull})
    model = replace(model, config=model.config.model_copy(update={"identification": options}))
    config = model.config

    def opened(name: str) -> CachedRecording:
        path = DATA / case.folder / name
        return CachedRecording(
            open_recording(path, model.chain.names, fmt=config.recording, transmission=config.transmission)
        )

    validation = [] if case.judged is None else [opened(case.judged)]
    return identify(model, [opened(case.fitted)], validation, method=method)


def violations(estimate: Estimate) -> int:
    """Links of the estimate whose 4x4 pseudo-inertia is not positive definite."""
    if estimate.delta is None:
        return estimate.base.size
    return sum(
        block.smallest(estimate.delta) <= 0.0 for block in estimate.conditions.blocks if "distribution" in block.name
    )


def judged(case: Case, candidate: Candidate) -> tuple[float, list[float]]:
    """Relative error of a candidate, whole and per joint [percent], on what the case judges on."""
    error = candidate.validation[0].error if case.judged is not None else candidate.identification
    return error.relative_percent, error.joint_relative_percent.tolist()


def command_seconds(case: Case, turns: int = 3) -> float:
    """Median CPU seconds of `ident identify` as it is called, with imports, report and proof, one core."""
    given = [
        sys.executable,
        "-m",
        "ident_service",
        "identify",
        str(DATA / case.folder / case.fitted),
        "--arm",
        case.arm,
    ]
    if case.judged is not None:
        given += ["--validate", str(DATA / case.folder / case.judged)]
    with tempfile.TemporaryDirectory() as folder:
        return statistics.median(cpu_seconds([*given, "--out", folder + "/result"])[0] for _ in range(turns))


_PAGE = """\
# Real recordings

Relative torque error (eq. 84) in percent of all rows, on recordings that were not fitted to; of the TX40 there is one
recording only, so its figures are on the recording fitted to. Links are those of the estimate that violate the
4x4 condition. Written by `make bench`.

{errors}

## Chosen from the recordings

The descriptions have no section `identification`: filter, friction's shape and estimator are chosen from the recording
that is fitted to. It is cut into thirds, and each third's torque is predicted from the other two. The first value is
taken unless another one predicts clearly better; for delay and friction, on every third and by more than thirds differ.

{choices}

## Time

Processor seconds of the whole `ident identify` with all estimates, verdicts, proof and report, on one core; of that,
`estimates` is what remains without starting, reading arguments and writing files.

{times}
"""


def _markdown(*rows: Sequence[str]) -> str:
    head, *others = (f"| {' | '.join(row)} |" for row in rows)
    return "\n".join([head, "|---" * len(rows[0]) + "|", *others])


def measure() -> tuple[list[Row], str]:
    """Rows for the benchmark table, and the page of all estimates in Markdown."""
    rows: list[Row] = []
    errors, choices, times = list[tuple[str, ...]](), list[tuple[str, ...]](), list[tuple[str, ...]]()
    for case in CASES:
        model = case_model(case)
        runs: list[tuple[str, Estimate, int]] = []
        runs.append(("OLS", case_estimate(case, "ols", model=model), 0))
        begun = process_time()
        chosen = case_estimate(case, None, model=model)
        seconds = process_time() - begun
        whole_command = command_seconds(case)
        label = chosen.method.upper()
        runs += [(label, chosen, 0), (f"{label} inertia", chosen, 2), (f"{label} pseudo_inertia", chosen, 3)]
        rows.append(
            Row(f"{case.arm}: ident identify, one core, CPU of the whole process", whole_command, "s", "<= 2.5")
        )
        rows.append(Row(f"{case.arm}: of that, estimates", seconds, "s"))
        times.append((case.arm, f"{whole_command:.1f}", f"{seconds:.1f}"))
        for one in chosen.choices:
            held_out = ", ".join(f"{name} {error:.3g} %" for name, error in one.held_out.items())
            choices.append((case.arm, f"`{one.option}`", one.value, held_out))
        if model.prior is not None:
            try:
                drawn = case_estimate(case, None, "entropic", model)
                runs.append((f"{label} pseudo_inertia, entropic prior", drawn, 3))
            except ParameterError as error:
                errors.append((case.arm, f"{label} pseudo_inertia, entropic prior", f"refused: {error}", "", ""))
        for name, estimate, index in runs:
            whole, joints = judged(case, estimate.candidates[index])
            count = str(violations(estimate)) if index == 3 else "-"
            per_joint = " ".join(f"{value:.1f}" for value in joints)
            errors.append((case.arm, name, f"{whole:.2f}", per_joint, count))
            if index == 3:
                rows.append(Row(f"{case.arm}: {name}", whole, "%", f"<= {case.target:g}"))
    page = _PAGE.format(
        errors=_markdown(("arm", "estimate", "all joints", "per joint", "links"), *errors),
        choices=_markdown(("arm", "setting", "taken", "torque error on held-out thirds"), *choices),
        times=_markdown(("arm", "seconds", "estimates"), *times),
    )
    return rows, page
