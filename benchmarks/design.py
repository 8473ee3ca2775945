"""Excitation design: what a minute of search reaches, against the published motion, and what the result is worth.

Ten seeds of a minute each and a few shorter searches; a plain search beside ours on five arms, three seeds of half a
minute each; what twice the time adds; and the run of twenty designed motions of four arms: about three hours.
`python -m benchmarks.design` for all of it, or the names of some of its parts: `evaluation wam gain small plain time
runs`. Searches are given seconds of one process's CPU time, so that a busy machine finds the same motions later.

IDENT_BENCH_SEEDS, IDENT_BENCH_SECONDS and IDENT_BENCH_ARMS change seeds (10), seconds (60) and the arms of `plain` and
`runs` (all).
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import Row, median_seconds, table, write
from benchmarks.plain_search import PlainSearch
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.motion_design import Criterion
from ident_service.config.motion_limits import motion_limits
from ident_service.estimation.identify import identify
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.design import Designed, complete_task, design_motion, motion_family
from ident_service.excitation.limit_proof import violations
from ident_service.excitation.motion_file import Excitation
from ident_service.excitation.optimal_design import Problem, usable_limits
from ident_service.excitation.prediction import described_noise, expected_deviations, information
from ident_service.excitation.search import Budget
from ident_service.excitation.trajectory import FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.state_machine import State
from ident_service.operations.commissioning import record_motion
from ident_service.recordings.adapters import RangeRecording
from ident_service.recordings.open import open_recording

_SEEDS = int(os.environ.get("IDENT_BENCH_SEEDS", "10"))
_SECONDS = float(os.environ.get("IDENT_BENCH_SECONDS", "60"))
_ARMS = os.environ.get("IDENT_BENCH_ARMS", "").split()
_CRITERIA: tuple[Criterion, ...] = ("condition_number", "d_optimal")
_RUNS = 2 * _SEEDS
_DUELS, _DUEL_SECONDS = min(3, _SEEDS), 0.5 * _SECONDS  # seeds, and the time of each search


def measure(parts: tuple[str, ...] = ()) -> list[Row]:
    """Return the figures of some parts, or of all."""
    plain, noisy = arm_model(load_arm("wam7")), arm_model(load_arm("wam7_sim"))
    every = {
        "evaluation": lambda: _evaluation(plain),
        "wam": lambda: _condition_numbers(plain),
        "gain": lambda: _gain(noisy),
        "small": _small_arms,
        "plain": against_plain_search,
        "time": more_time,
        "runs": designed_runs,
    }
    return [row for part in parts or every for row in every[part]()]


def _designed(model: ArmModel, criterion: Criterion, seed: int, seconds: float, **changes: object) -> Designed:
    design = model.config.design.model_copy(update={"criterion": criterion, **changes})
    return design_motion(model, design, seed=seed, budget=_budget(seconds))


def _budget(seconds: float) -> Budget:
    return Budget(seconds, None, 1, time.process_time)


def _evaluation(model: ArmModel) -> list[Row]:
    rows = []
    for criterion in ("condition_number", "d_optimal"):
        design = model.config.design.model_copy(update={"criterion": criterion, "position_margin": 0.15, "ramp": 0.0})
        basis, base = motion_family(design, model)
        problem = Problem(complete_task(model, design, basis, base), 500)
        x = 0.3 * np.random.default_rng(0).normal(size=problem.size)
        multipliers = problem.no_multipliers(1.0)
        with one_blas_thread():
            seconds = median_seconds(lambda p=problem, x=x, m=multipliers: p.value_and_gradient(x, 8.0, m), 51, 5)
        limits = ", ".join(problem.names)
        rows.append(
            Row(
                f"one evaluation at 500 points, WAM, {criterion}, with gradient ({limits})",
                1e3 * seconds,
                "ms",
                "<= 20",
            )
        )
    return rows


def _condition_numbers(model: ArmModel) -> list[Row]:
    base = base_parameters(model.chain, model.layout)
    published = excitation(model, "identification").path
    ones = np.ones(model.chain.joints)
    rows = [Row("condition number, WAM, published motion", _root(information(published, model, base, ones)), "", None)]
    reached = []
    for seed in range(_SEEDS):
        begun = time.process_time()
        # What two cores do in that time, which is the default of `ident design`.
        found = _designed(model, "condition_number", seed, 2.0 * _SECONDS, position_margin=0.15)
        _require_proven(model, found, 0.15)
        reached.append(found.condition_number)
        rows.append(Row(f"condition number, WAM, seed {seed}, all limits proven", found.condition_number, "", None))
        print(f"seed {seed}: {found.condition_number:.2f} after {time.process_time() - begun:.1f} s of CPU", flush=True)
    return [
        *rows,
        Row("condition number, WAM, median of the seeds", statistics.median(reached), "", "<= 32"),
        Row(
            f"seeds of {_SEEDS} whose condition number is at most 40", sum(k <= 40.0 for k in reached), "", ">= 9 of 10"
        ),
    ]


def _gain(model: ArmModel) -> list[Row]:
    base, noise = base_parameters(model.chain, model.layout), described_noise(model, motion_limits(model.config))
    published = excitation(model, "identification")
    found = _designed(model, "d_optimal", 0, 2.0 * _SECONDS, position_margin=0.15)
    _require_proven(model, found, 0.15)
    ours, theirs = (
        float(np.linalg.slogdet(information(path, model, base, noise.deviation))[1])
        for path in (found.excitation.path, published.path)
    )
    with tempfile.TemporaryDirectory() as folder:
        measured = _deviations(model, found.excitation, Path(folder) / "designed.mcap")
        before = _deviations(model, published, Path(folder) / "published.mcap")
    expected = [expected_deviations(motion.path, model, base, noise) for motion in (found.excitation, published)]
    print(f"{'base parameter':<70} {'traj1':>10} {'designed':>10} {'ratio':>7}")
    for expression, new, old in zip(base.expressions, measured, before, strict=True):
        print(f"{expression:<70} {old:>10.3g} {new:>10.3g} {new / old:>7.3f}")
    return [
        Row(
            "D-optimality, WAM: exp(gain in log-det / 69) against traj1",
            float(np.exp((ours - theirs) / base.size)),
            "",
            ">= 3.3",
        ),
        Row(
            "sigma(designed) / sigma(traj1), simulated WAM, 60 s each, geometric mean",
            _mean_ratio(measured, before),
            "",
            "< 0.7",
        ),
        Row("the same, as the preview expects it", _mean_ratio(*expected), "", None),
    ]


def _small_arms() -> list[Row]:
    rows = []
    for name in ("planar2", "sixaxis"):
        model = arm_model(load_arm(name))
        base, noise = base_parameters(model.chain, model.layout), described_noise(model, motion_limits(model.config))
        given = excitation(model, "identification").path
        begun = time.process_time()
        found = _designed(model, "d_optimal", 0, 15.0)
        seconds = time.process_time() - begun
        gain = [
            float(np.linalg.slogdet(information(path, model, base, noise.deviation))[1])
            for path in (found.excitation.path, given)
        ]
        rows += [
            Row(f"design for {name}, whole", seconds, "s", "< 20"),
            Row(
                "its exp(gain in log-det / n) against the seeded motion",
                float(np.exp((gain[0] - gain[1]) / base.size)),
                "",
                None,
            ),
        ]
    return rows


def bench_arms() -> dict[str, ArmModel]:
    """Five arms that the searches are compared on."""
    ur10 = load_arm("ur10").model_dump(by_alias=True)
    # A description for identification only: limits, gains and bodies as round as a first guess would be.
    for joint in ur10["joints"].values():
        joint |= {"position": [-3.0, 3.0], "acceleration": 8.0, "jerk": 80.0, "following_error": 0.2, "home": 0.0}
        joint |= {"kp": 400.0, "kd": 40.0, "brake": True, "drive_inertia": 1.0}
    ur10["joints"]["shoulder_lift_joint"]["home"] = -1.5
    masses = (7.8, 12.9, 3.9, 2.0, 2.0, 0.2)
    ur10["prior"] = {f"m{k}": mass for k, mass in enumerate(masses, start=1)}
    ur10["prior"] |= {
        f"L{axis}{k}": 0.02 * mass for k, mass in enumerate(masses, start=1) for axis in ("xx", "yy", "zz")
    }
    ur10["workspace"] = {"clearance": 0.0}
    names = {"wam7": "wam7", "six-axis": "sixaxis", "planar": "planar2"}
    arms = {name: arm_model(load_arm(arm)) for name, arm in names.items()}
    arms["panda-like"] = arm_model(load_arm(Path(__file__).parent / "arms" / "panda_like.yaml"))
    arms["ur10"] = arm_model(ArmConfig.model_validate(ur10))
    return arms


def against_plain_search() -> list[Row]:
    """Both searches on five arms: same family, same limits and margins, same CPU time, one process each.

    Proofs take time that our search is not given; the plain search, which proves nothing, searches in it.
    """
    rows = []
    for name, model in bench_arms().items():
        if _ARMS and name not in _ARMS:
            continue
        base, limits = base_parameters(model.chain, model.layout), motion_limits(model.config)
        noise, design = described_noise(model, limits).deviation, model.config.design
        plain = PlainSearch(model, design, usable_limits(model.chain.names, limits, design), base.base, noise)
        for criterion in _CRITERIA:
            changed = design.model_copy(update={"criterion": criterion})
            ours, theirs = [], []
            for seed in range(_DUELS):
                begun = time.process_time()
                found = design_motion(model, changed, seed=seed, budget=_budget(_DUEL_SECONDS)).excitation.path
                taken = time.process_time() - begun
                ours.append(_figure(found, model, base, noise, criterion))
                theirs.append(_figure(plain.run(criterion, seed, taken), model, base, noise, criterion))
                print(
                    f"{name}, {criterion}, seed {seed}: {ours[-1]:.5g} against {theirs[-1]:.5g}, {taken:.0f} s each",
                    flush=True,
                )
            rows += _duel(name, criterion, ours, theirs, base.size)
    return rows


def _duel(name: str, criterion: Criterion, ours: list[float], theirs: list[float], size: int) -> list[Row]:
    """Return medians of both searches, and how many times as good ours is: above one where it is better."""
    ratio = _times_as_good(criterion, ours, theirs, size)
    return [
        Row(f"{criterion}, {name}, ours, median", statistics.median(ours), "", None),
        Row(f"{criterion}, {name}, plain search, median", statistics.median(theirs), "", None),
        Row(f"{criterion}, {name}: times as good as the plain search", ratio, "", ">= 1"),
    ]


def _times_as_good(criterion: Criterion, ours: list[float], theirs: list[float], size: int) -> float:
    """Return the ratio of median condition numbers, or of median information per parameter."""
    pair = statistics.median(ours), statistics.median(theirs)
    return pair[1] / pair[0] if criterion == "condition_number" else float(np.exp((pair[0] - pair[1]) / size))


def more_time() -> list[Row]:
    """What twice the time finds, the same seeds."""
    rows = []
    arms = bench_arms()
    for name in ("wam7", "panda-like"):
        model = arms[name]
        base, noise = base_parameters(model.chain, model.layout), described_noise(model, motion_limits(model.config))
        for criterion in _CRITERIA:
            found = {
                seconds: [
                    _figure(
                        _designed(model, criterion, seed, seconds).excitation.path,
                        model,
                        base,
                        noise.deviation,
                        criterion,
                    )
                    for seed in range(_DUELS)
                ]
                for seconds in (_SECONDS, 0.5 * _SECONDS)
            }
            longer, shorter = found.values()
            ratio = _times_as_good(criterion, longer, shorter, base.size)
            rows.append(Row(f"{criterion}, {name}: {_SECONDS:g} s, times as good as half the time", ratio, "", ">= 1"))
    return rows


def designed_runs() -> list[Row]:
    """Run motions of twenty seeds of four arms, as their descriptions ask for them, in simulation at their own rate."""
    rows = []
    for name in ("planar2", "threelink", "sixaxis", "wam7_sim"):
        if _ARMS and name not in _ARMS:
            continue
        arm = load_arm(name)
        model = arm_model(arm)
        done = 0
        for seed in range(_RUNS):
            motion = design_motion(model, arm.design, seed=seed, budget=Budget(None, 2, 1)).excitation
            with tempfile.TemporaryDirectory() as folder:
                report = record_motion(make_arm(arm), model, motion, Path(folder) / "run.mcap")
            done += report.state is State.DONE
            used = (np.asarray(report.peak_torque) / motion_limits(arm).torque).max()
            print(f"{name}, seed {seed}: {report.state.name}, {report.warnings}, torque to {used:.2f}", flush=True)
        rows.append(Row(f"designed motions of {name} that run to their end, of {_RUNS}", done, "", f">= {_RUNS}"))
    return rows


def _figure(
    path: FourierPath | PosturePath, model: ArmModel, base: BaseParameters, noise: np.ndarray, criterion: Criterion
) -> float:
    """Condition number of the plain rows, or log-determinant of the whitened information per second."""
    if criterion == "condition_number":
        return _root(information(path, model, base, np.ones_like(noise)))
    return float(np.linalg.slogdet(information(path, model, base, noise))[1])


def _require_proven(model: ArmModel, found: Designed, margin: float) -> None:
    limits = motion_limits(model.config)
    if wrong := violations(found.proof, model, limits):
        raise AssertionError(wrong)
    asked = found.proof.demands
    if not ((asked.lowest >= limits.lower + margin).all() and (asked.highest <= limits.upper - margin).all()):
        raise AssertionError("the margin is not kept")


def _deviations(model: ArmModel, motion: Excitation, path: Path) -> np.ndarray:
    """Standard deviations found from the minute that a motion runs at full size."""
    report = record_motion(make_arm(model.config), model, motion, path)
    recording = open_recording(path, model.chain.names)
    fourier = motion.path
    if not isinstance(fourier, FourierPath):
        raise TypeError("a Fourier motion")
    rate = model.config.control.rate
    around = report.cycles / rate - fourier.periods * fourier.series.period
    part = RangeRecording(recording, 0.5 * around, report.cycles / rate - 0.5 * around)
    return identify(model, [part]).standard_deviations


def _mean_ratio(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.exp(np.mean(np.log(ours / theirs))))


def _root(G: np.ndarray) -> float:
    return float(np.sqrt(np.linalg.cond(G)))


if __name__ == "__main__":
    found = measure(tuple(sys.argv[1:]))
    print(table(found))
    print(f"written to {write(found, Path(__file__).parent / 'results', 'design')}")
