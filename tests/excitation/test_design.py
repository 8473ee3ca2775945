"""A designed motion: most informative, moving, proven; for small arms and for arms that can hardly move at all."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from design_bench import ONE_START, moves, quick, small, unproven

from ident_service.config.motion_limits import motion_limits
from ident_service.errors import MotionRefused
from ident_service.excitation.design import Designed, complete_task, criterion_of, design_motion, motion_family
from ident_service.excitation.motion_file import excitation_from_json
from ident_service.excitation.optimal_design import usable_limits
from ident_service.excitation.search import Budget
from ident_service.model.arm_model import ArmModel

KINDS: list[Any] = ["d_optimal", "a_optimal", "condition_number"]
NOTHING = Budget(seconds=None, starts=0, workers=1)


@lru_cache
def designed_once(name: str, kind: Any, starts: int, seed: int = 0) -> Designed:
    """A quick design that several tests look at."""
    budget = Budget(seconds=None, starts=starts, workers=1)
    return design_motion(small(name), quick(criterion=kind), seed=seed, budget=budget)


def assert_good(model: ArmModel, **changes: Any) -> None:
    """One start gives a motion that moves, and everything about it is proven."""
    design = quick(**changes)
    designed = design_motion(model, design, budget=ONE_START)
    limits = usable_limits(model.chain.names, motion_limits(model.config), design)
    assert unproven(designed, model, limits) == []
    assert moves(designed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "starts"),
    [
        ("planar2", "d_optimal", 2),
        *(pytest.param("planar2", kind, 1, marks=pytest.mark.campaign) for kind in KINDS[1:]),
        ("threelink", "d_optimal", 1),  # a sliding joint
        *(pytest.param("threelink", kind, 2, marks=pytest.mark.campaign) for kind in KINDS),
    ],
)
def test_starts_give_a_proven_motion(name: str, kind: Any, starts: int) -> None:
    model = small(name)
    designed = designed_once(name, kind, starts)
    limits = usable_limits(model.chain.names, motion_limits(model.config), quick(criterion=kind))
    assert unproven(designed, model, limits) == []
    assert moves(designed)
    assert np.isfinite(designed.condition_number)
    assert designed.found.finished == starts


@pytest.mark.slow
def test_a_motion_begins_and_ends_at_rest() -> None:
    path = designed_once("planar2", "d_optimal", 1).excitation.path
    for time in (0.0, path.duration):
        for rate in path.at(time)[1:]:
            np.testing.assert_array_equal(rate, 0.0)


@pytest.mark.campaign
@pytest.mark.slow
def test_the_same_seed_gives_the_same_motion() -> None:
    one, other = (designed_once("planar2", "d_optimal", 1, seed) for seed in (0, 4))
    again = design_motion(small(), quick(), seed=0, budget=ONE_START)
    assert one.excitation.to_json() == again.excitation.to_json()
    assert one.excitation.to_json() != other.excitation.to_json()


@pytest.mark.slow
def test_the_file_says_how_the_motion_was_made_and_what_was_proven() -> None:
    designed = designed_once("planar2", "d_optimal", 1, 4)
    content = json.loads(designed.excitation.to_json())
    assert content["arm"]["sha256"] == small().config.motion_sha256
    made = content["made"]
    assert (made["seed"], made["starts"], made["criterion"], made["torque_margin"]) == (4, 1, "d_optimal", 0.2)
    np.testing.assert_allclose(made["bounds"]["torque"], designed.proof.demands.torque)
    again = excitation_from_json(designed.excitation.to_json())
    assert again.to_json() == designed.excitation.to_json()


@pytest.mark.slow
@pytest.mark.parametrize("starts", [2, pytest.param(4, marks=pytest.mark.campaign)])
def test_more_starts_are_never_worse(starts: int) -> None:
    model, design = small(), quick()
    basis, base = motion_family(design, model)
    task = complete_task(model, design, basis, base)
    few, more = (designed_once("planar2", "d_optimal", n) for n in (1, starts))
    worse, better = (criterion_of(task, designed.excitation.path, base) for designed in (few, more))
    assert better <= worse + 0.02  # a proof may cost the better one a little


@pytest.mark.slow
def test_an_arm_whose_home_is_the_end_of_its_range_can_stand_still_too() -> None:
    model = small(joints={"shoulder": {"position": [0.0, 1.8]}, "elbow": {"position": [-2.0, 0.0]}})
    designed = design_motion(model, quick(), budget=NOTHING)
    limits = usable_limits(model.chain.names, motion_limits(model.config), quick())
    assert unproven(designed, model, limits) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planar2", "threelink"])
def test_without_a_single_start_the_arm_stands_still_and_that_is_proven(name: str) -> None:
    model, design = small(name), quick()
    designed = design_motion(model, design, budget=NOTHING)
    limits = usable_limits(model.chain.names, motion_limits(model.config), design)
    assert unproven(designed, model, limits) == []
    np.testing.assert_array_equal(designed.proof.demands.velocity, 0.0)
    assert designed.condition_number == np.inf
    # It is a motion that can be written and read like any other.
    assert json.loads(designed.excitation.to_json())["made"]["condition_number"] is None


@pytest.mark.slow
def test_a_design_that_is_cancelled_at_once_is_a_motion_too() -> None:
    designed = design_motion(small(), quick(), budget=ONE_START, cancelled=lambda: True)
    assert excitation_from_json(designed.excitation.to_json()).duration > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.02, pytest.param(1.2, marks=pytest.mark.campaign)])
def test_an_arm_whose_torque_hardly_holds_it_moves(share: float) -> None:
    # Stretched out, shoulder and elbow need 12.26 and 2.45 N m; there is a little more than that.
    model = small(joints={"shoulder": {"torque": 12.2625 * share}, "elbow": {"torque": 2.4525 * share}})
    assert_good(model, torque_margin=0.0)


@pytest.mark.campaign
@pytest.mark.slow
@pytest.mark.parametrize("torque", [pytest.param(3.0, marks=pytest.mark.campaign), 0.5])
def test_an_arm_that_can_only_hang_moves_about_hanging(torque: float) -> None:
    # Far too weak to be stretched out; about hanging straight down there is room for little.
    model = small(
        joints={
            "shoulder": {"torque": torque, "position": [-2.4, 1.8], "home": -1.5707963},
            "elbow": {"torque": torque},
        }
    )
    assert_good(model, torque_margin=0.0)


def test_an_arm_that_cannot_be_held_at_home_is_not_sent_anywhere() -> None:
    # Motions begin at home, stretched out level, where it is far too weak.
    model = small(joints={"shoulder": {"torque": 3.0, "position": [-2.4, 1.8]}, "elbow": {"torque": 3.0}})
    with pytest.raises(MotionRefused, match=r"cannot be held at home.*shoulder: torque"):
        assert_good(model, torque_margin=0.0)


@pytest.mark.campaign
@pytest.mark.slow
def test_a_narrow_box_leaves_room_for_a_small_motion() -> None:
    # The outer link ends one metre ahead at home, and may go 6 cm up and down.
    model = small(workspace={"inside": {"y": [-0.12, 0.12]}})
    assert_good(model)


@pytest.mark.campaign
@pytest.mark.slow
def test_a_supply_that_hardly_feeds_the_drives_slows_the_motion_down() -> None:
    model = small(supply={"power": 3.0, "standby": 2.0})
    assert_good(model)


@pytest.mark.campaign
@pytest.mark.slow
def test_a_supply_whose_losses_matter_holds_the_arm_where_it_needs_no_torque() -> None:
    model = small(
        joints={"shoulder": {"position": [-2.4, 1.8], "home": -1.5707963}},
        supply={"power": 3.0, "standby": 2.0, "loss": 0.5},
    )
    assert_good(model)


@pytest.mark.slow
def test_home_at_the_end_of_a_range_is_no_obstacle() -> None:
    model = small(joints={"shoulder": {"position": [0.0, 1.8]}, "elbow": {"position": [0.0, 2.0]}})
    assert_good(model)


@pytest.mark.campaign
@pytest.mark.slow
def test_home_at_the_end_of_a_range_of_a_weak_arm_is_no_obstacle() -> None:
    # It hangs at the end of its range, and is too weak for most other postures.
    model = small(
        joints={
            "shoulder": {"torque": 4.0, "position": [-1.5707963, 1.8], "home": -1.5707963},
            "elbow": {"torque": 2.0, "position": [0.0, 2.0]},
        }
    )
    assert_good(model, torque_margin=0.0)


@pytest.mark.slow
def test_a_narrow_range_of_one_joint_is_used() -> None:
    assert_good(small(joints={"elbow": {"position": [-0.08, 0.08]}}))


@pytest.mark.campaign
@pytest.mark.slow
def test_slow_joints_move_slowly() -> None:
    assert_good(small(joints={"elbow": {"velocity": 0.01, "acceleration": 0.01, "jerk": 0.1}}))


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(40))
def test_whatever_the_limits_one_start_gives_a_proven_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    joints = {}
    for name, hold in (("shoulder", 12.2625), ("elbow", 2.4525)):
        lower, upper = -rng.uniform(0.1, 1.8), rng.uniform(0.1, 1.8)
        speed = 10.0 ** rng.uniform(-1.5, 0.3)
        joints[name] = {
            "position": [lower, upper], "home": rng.uniform(lower, upper), "velocity": speed,
            "acceleration": speed * 10.0 ** rng.uniform(-0.5, 1.0), "jerk": speed * 10.0 ** rng.uniform(0.0, 2.0),
            "torque": hold * 10.0 ** rng.uniform(0.15, 1.0),
        }  # fmt: skip
    supply = {"power": 10.0 ** rng.uniform(0.5, 2.0), "loss": rng.uniform(0.0, 0.001), "standby": 1.0}
    assert_good(small(joints=joints, supply=supply), position_margin=0.01)
