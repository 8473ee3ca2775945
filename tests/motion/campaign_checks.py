"""What every run of the fault campaign is held to, on whatever arm it is.

It must end in what the table in `motion/faults.py` promises, within its time, latched, with one plain sentence and a
readable recording. As the plant sees it, torque never exceeds its limit. Velocity may reach the guard's threshold of
torque off, `VELOCITY_OFF` times the limit, and what a joint gains while the velocity filter (30 Hz) and two cycles have
not shown it yet; what an arm does after its torque is gone is physics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from branches import outcomes
from campaign_bench import (
    HOLD,
    Case,
    Outcome,
    Promise,
    Strike,
    Subject,
    injected,
    play,
    script_of,
    subject,
    windows,
)
from motion_bench import LOOKED

from drivers.arm import StopKind
from ident_service.errors import MotionRefused
from ident_service.motion.after_stop import RESTING, SPEED
from ident_service.motion.control_loop import REST_CYCLES
from ident_service.motion.faults import FAULTS, LOWER, LOWER_AFTER, SETTLE, Reaction
from ident_service.motion.run import run
from ident_service.motion.safety_monitor import VELOCITY_OFF
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.open import open_recording
from sim_backend.faults import Fault


def keeps_its_promise(case: Case, folder: Path) -> Outcome:
    which, fault, path = subject(case.arm), injected(case), folder / "run.mcap"
    outcome = play(which, case.state, (fault,), path, case.speed, finish=case.finish)
    is_kept(case, fault, outcome, path)
    return outcome


def keep_their_promises(
    cases: Sequence[Case], folder: Path, also: Callable[[Case, Outcome], None] = lambda case, outcome: None
) -> None:
    """Check cases of one arm, script and speed, in branches of one run, whose recordings are written afterwards."""
    one = cases[0]
    faults = [injected(case) for case in cases]

    def check(number: int, outcome: Outcome) -> None:
        case, path = cases[number], folder / f"{number}.mcap"
        chain = subject(case.arm).model.chain
        with RecordingWriter(path, chain.names, "<robot/>", 0) as writer:
            for sample in outcome.story.samples:
                writer.sample(Cycle(**sample))
            for event in outcome.story.events:
                writer.event(*event)
        try:
            is_kept(case, faults[number], outcome, path)
            also(case, outcome)
        except AssertionError as error:
            error.add_note(str(case))
            raise

    outcomes(subject(one.arm), one.state, faults, check, one.speed, finish=one.finish)


def together(cases: Sequence[Case]) -> list[Any]:
    """The cases that one run can have in branches, for each such run."""
    return [pytest.param(group, id=name) for name, group in _groups(cases).items()]


def in_runs(cases: Sequence[Case], most: int = 12) -> list[Any]:
    """All cases of a campaign, so many at most in branches of one run: most of the time goes to what leads to a fault.

    What fails is told by its case, which `keeps_its_promise` plays by itself.
    """
    return [
        pytest.param(group[begin : begin + most], id=f"{name}-{begin}")
        for name, group in _groups(cases).items()
        for begin in range(0, len(group), most)
    ]


def _groups(cases: Sequence[Case]) -> dict[str, list[Case]]:
    groups: dict[str, list[Case]] = {}
    for case in cases:
        script = "finished" if case.finish else script_of(case.state).value
        groups.setdefault(f"{case.arm}-{script}-{case.speed:g}", []).append(case)
    return groups


def is_kept(case: Case, fault: Fault | Strike, outcome: Outcome, path: Path) -> None:
    """Hold one outcome to its promise."""
    which = subject(case.arm)
    plant_stays_within_limits(which, outcome, case)
    recording_is_readable(which, outcome, path)
    promise = which.promises[case.kind]
    if outcome.fault is None:
        went_on(case, promise, fault.at_cycle, outcome)
        return
    assert outcome.fault.code in promise.codes, outcome.fault
    assert any(words in str(outcome.fault) for words in promise.words or ("",)), outcome.fault
    is_latched(which, outcome)
    ends_as_the_table_says(which, outcome)
    ends_in_time(which, outcome)
    if promise.within is not None:
        assert found_in(which, outcome) < fault.at_cycle + promise.within
        assert found_in(which, outcome) >= fault.at_cycle


def went_on(case: Case, promise: Promise, at_cycle: int, outcome: Outcome) -> None:
    """The run ended as if nothing had been: nobody could tell, it was but a warning, or there was no time left."""
    if promise.within is not None:
        assert outcome.arm.cycle <= at_cycle + promise.within, "not found"
    assert outcome.latch.faults == ()
    assert list(dict.fromkeys(outcome.story.states)) == list(
        windows(case.arm, case.state, case.speed, finish=case.finish)
    )
    if promise.warns is not None and outcome.arm.cycle > at_cycle + promise.told_after:
        (told,) = [message for _, _, message in outcome.story.events if message.startswith(f"{promise.warns}: ")]
        assert any(words in told for words in promise.words), told


def plant_stays_within_limits(which: Subject, outcome: Outcome, case: Case) -> None:
    limits, truth = which.limits, outcome.truth
    torque = np.abs([moment.torque for moment in truth])
    most = limits.torque
    if case.kind == "torque_sign" and limits.motors is not None and which.config.transmission is not None:
        # Two motors that share a joint add up where they should balance: what motors give is then all that holds.
        gears = which.config.transmission
        jacobian = np.array(gears.ratios)[:, None] * np.array(gears.coupling)
        most = np.maximum(most, np.abs(jacobian).T @ limits.motors.torque)
    assert (torque <= most * (1 + 1e-9) + which.torque_step).all()
    speed, acceleration = (np.abs([getattr(moment, name) for moment in truth]) for name in ("velocity", "acceleration"))
    # Of positions that come so late without saying so nobody can know sooner: 20 ms in which a joint of the WAM that
    # swings at 180 rad/s^2 gains 3.6 rad/s, and had gained 0.6.
    hidden = which.promises[case.kind].size if case.kind == "hidden_delay" else 0.0
    unseen = 1.0 / (2.0 * np.pi * np.asarray(which.config.control.velocity_cutoff)) + 2.0 * which.period + hidden
    gained = acceleration[-20 - round(hidden / which.period) :].max(axis=0) * unseen
    assert (speed <= VELOCITY_OFF * limits.velocity + gained).all()


def recording_is_readable(which: Subject, outcome: Outcome, path: Path) -> None:
    blocks = list(open_recording(path, which.model.chain.names).blocks())
    assert sum(len(block.position) for block in blocks) == len(outcome.story.samples)


def is_latched(which: Subject, outcome: Outcome) -> None:
    assert outcome.fault is not None
    codes = [fault.code for fault in outcome.latch.faults]
    assert codes[-1] == outcome.fault.code
    reactions = [FAULTS[code].reaction for code in codes]
    assert reactions == sorted(set(reactions))  # one-way
    for fault in outcome.latch.faults:
        assert "\n" not in fault.cause
        assert fault.cause.endswith(FAULTS[fault.code].means)
        assert len(fault.cause) > len(FAULTS[fault.code].means) + 10
        assert f"{fault.code}: {fault.cause}" in outcome.story.errors
    with pytest.raises(MotionRefused, match=codes[0]):
        run(outcome.arm, which.model, which.motion, outcome.story, active_faults=outcome.latch)
    for code in codes:
        outcome.latch.acknowledge(code)
    assert outcome.latch.faults == ()


def ends_as_the_table_says(which: Subject, outcome: Outcome) -> None:
    """The last state, how torque ended, and that none was sent after it had."""
    assert outcome.fault is not None
    reaction = FAULTS[outcome.fault.code].reaction
    controlled = reaction is Reaction.CONTROLLED_STOP
    if controlled:
        assert outcome.story.states[-2:] == ["stopping", "stopped"]
    else:
        assert outcome.story.states[-1] == "faulted"
    # Without brakes an arm is lowered first, and then needs no torque.
    lowered = which.config.control.after_stop is not None and reaction <= Reaction.DAMPED_LOWERING
    kind = StopKind.TORQUE_OFF if lowered else reaction.stop_kind
    assert outcome.arm.stops == [kind]
    assert lowered or kind is (StopKind.TORQUE_OFF if reaction is Reaction.TORQUE_OFF else StopKind.QUICK_STOP)
    assert len(outcome.arm.torques) == outcome.arm.cycle - LOOKED


def ends_in_time(which: Subject, outcome: Outcome) -> None:
    """From the first fault that is more than a warning to the end."""
    assert outcome.fault is not None
    limits = which.limits
    stop = (limits.velocity + 0.5 * limits.acceleration**2 / limits.jerk) / limits.acceleration
    stop = stop + 2.0 * limits.acceleration / limits.jerk
    controlled = float(stop.max()) + SETTLE + REST_CYCLES * which.period + HOLD
    if which.config.control.after_stop is not None:
        # From one end of each joint's range to the other, one after the other, because gravity compensation goes only
        # while the fastest joint is slow; and as long again for what it takes to go.
        controlled += 2.0 * float(((limits.upper - limits.lower) / (SPEED * limits.velocity)).sum()) + RESTING
    promised = {Reaction.CONTROLLED_STOP: controlled, Reaction.DAMPED_LOWERING: controlled + LOWER_AFTER + LOWER}
    # Every reaction on the way there may have taken its time.
    reactions = [FAULTS[message.split(":")[0]].reaction for message in outcome.story.errors]
    worst = max(promised.get(reaction, 0.0) for reaction in reactions)
    assert (outcome.arm.cycle - 1 - found_in(which, outcome)) * which.period <= worst + 2.0 * which.period


def found_in(which: Subject, outcome: Outcome) -> int:
    """The cycle in which the first fault that is more than a warning was found."""
    first = outcome.story.errors[0]
    if FAULTS[first.split(":")[0]].reaction >= Reaction.QUICK_STOP:
        return outcome.arm.cycle - 1
    stamp = next(stamp for stamp, _, message in outcome.story.events if message == first)
    last = outcome.story.samples[-1]
    if stamp > last["stamp_ns"]:  # an arm that is held or lowered for long is no longer recorded
        return int(last["cycle"]) + round((stamp - last["stamp_ns"]) * 1e-9 / which.period)
    return int(next(sample["cycle"] for sample in outcome.story.samples if sample["stamp_ns"] == stamp))
