"""Change points over a fleet of drawn estimates: found where they are, and hardly ever where nothing has changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from ident_service.estimation.change_detection import ALPHA, Kind
from ident_service.estimation.least_squares import ordinary_least_squares, torque_error
from ident_service.estimation.uncertainty import Uncertainty
from ident_service.fleet.factor import Row
from ident_service.fleet.population import ArmFit
from ident_service.fleet.reduction import Recorded
from ident_service.fleet.trends import Change, change_points, dependences, parameter_series, scatter_of
from ident_service.model.information import Information, triangle

GROUPS: dict[tuple[Kind, int], tuple[int, ...]] = {
    ("friction", 1): (0, 1),
    ("friction", 2): (2, 3),
    ("first moments", 2): (4,),
}
SIZE, ARMS, COUNT = 5, 30, 10
NOISE = 0.02
WEEK = 7 * 86_400.0


def fit() -> ArmFit:
    """An arm whose every parameter of 1 makes a torque of 1 N m at both joints."""
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((400, SIZE))
    torque = rows @ np.ones(SIZE) + 0.05 * rng.standard_normal(400)
    R = triangle(np.column_stack([rows, torque]))
    total = Information((np.arange(SIZE),) * 2, (R, R), np.array([400, 400]), SIZE)
    found = ordinary_least_squares(total)
    doubt = Uncertainty(np.eye(SIZE) * NOISE**2, np.full(SIZE, NOISE), np.full(SIZE, 50.0))
    return ArmFit(found, doubt, 12, np.eye(SIZE), total, torque_error(total, found.beta))


FIT = fit()


def recorded(values: np.ndarray, week: int, told: float = NOISE, **conditions: float) -> Recorded:
    covariances = tuple(told**2 * np.eye(len(places)) for places in GROUPS.values())
    one = np.ones(2)
    row = Row(
        key=f"{week}",
        sha256=f"{week}",
        label="",
        stamp=week * WEEK,
        seconds=10.0,
        rate=100.0,
        beta=values,
        deviations=np.full(SIZE, told),
        covariances=covariances,
        blocks=12,
        noise=one,
        torque=one,
        error=1.0,
        gaps=0,
        saturated=0.0,
        warnings=(),
        conditions=conditions,
    )
    return Recorded(f"/arms/{week}.mcap", row, week * WEEK)


def fleet(seed: int, scatter: float = 0.0, count: int = COUNT) -> dict[str, list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    found = {}
    for arm in range(ARMS):
        level = 1.0 + 0.1 * rng.standard_normal(SIZE)
        found[f"{arm:02}"] = list(level + np.hypot(NOISE, scatter) * rng.standard_normal((count, SIZE)))
    return found


def changes_of(values: dict[str, list[np.ndarray]], told: float = NOISE) -> list[Change]:
    arms: dict[str, Sequence[Recorded]] = {
        arm: [recorded(one, week, told) for week, one in enumerate(of_arm)] for arm, of_arm in values.items()
    }
    return change_points(arms, dict.fromkeys(arms, FIT), GROUPS, scatter_of(arms, GROUPS))


def test_a_change_is_found_at_its_date_in_its_group() -> None:
    values = fleet(5)
    for week in range(6, COUNT):
        values["07"][week][[2, 3]] += 0.15
    found = [one for one in changes_of(values) if one.changed]
    assert [(one.arm, one.group, one.at) for one in found] == [("07", ("friction", 2), 6)]
    (change,) = found
    assert (change.before, change.after) == (5 * WEEK, 6 * WEEK)
    assert np.all(np.abs(change.step - 0.15) < 4.0 * change.deviations)
    assert change.p < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scatter", "told", "seeds"),
    [
        pytest.param(0.0, NOISE, 30, marks=pytest.mark.campaign),
        (0.05, NOISE, 5),
        (0.0, 0.5 * NOISE, 5),
    ],
)
def test_unchanged_fleets_raise_no_alarm(scatter: float, told: float, seeds: int) -> None:
    """Also where recordings of one arm differ by more than their covariances say."""
    alarms = sum(any(one.changed for one in changes_of(fleet(seed, scatter), told)) for seed in range(seeds))
    assert alarms <= 1


def test_a_recording_that_is_too_sure_of_itself_by_chance_is_no_change() -> None:
    """Its covariance comes from a dozen blocks, and it is off by no more than it should have said."""
    values = fleet(5)
    arms = {arm: [recorded(one, week) for week, one in enumerate(of_arm)] for arm, of_arm in values.items()}
    off = np.mean(values["07"], axis=0)
    off[[2, 3]] += 2.7 * NOISE
    arms["07"][5] = recorded(off, 5, NOISE / 3.0)
    found = change_points(arms, dict.fromkeys(arms, FIT), GROUPS, scatter_of(arms, GROUPS))
    odd = min(found, key=lambda one: one.p)
    assert (odd.arm, odd.group) == ("07", ("friction", 2))
    assert not odd.changed
    assert odd.p > ALPHA


def test_the_family_is_the_whole_fleet() -> None:
    every = changes_of(fleet(11))
    assert len(every) == ARMS * len(GROUPS)
    # The smallest of 90 uniform probabilities is about a ninetieth; corrected it is of the order of one.
    assert min(one.p for one in every) > ALPHA


def test_a_change_that_makes_no_torque_is_no_alarm() -> None:
    values = {arm: [1.0 + 1e-3 * (one - 1.0) for one in of_arm] for arm, of_arm in fleet(5).items()}
    for week in range(6, COUNT):
        values["07"][week][2] += 0.004
    found = min(changes_of(values, 1e-3 * NOISE), key=lambda one: one.p)
    assert found.arm == "07"
    assert found.p < ALPHA
    assert not found.changed


def test_a_slow_drift_is_found_and_distinguished_from_a_step() -> None:
    """Find a drift that no single date shows: from week to week it is less than the noise."""
    values = fleet(5)
    for week in range(COUNT):
        values["07"][week][[2, 3]] += 0.012 * week
    found = [one for one in changes_of(values) if one.changed]
    assert [(one.arm, one.group, one.drift) for one in found] == [("07", ("friction", 2), True)]
    (change,) = found
    assert (change.before, change.after) == (0.0, (COUNT - 1) * WEEK)
    assert np.all(np.abs(change.step - 0.012 * (COUNT - 1)) < 4.0 * change.deviations)
    assert not next(one for one in changes_of(stepped()) if one.changed).drift


def stepped() -> dict[str, list[np.ndarray]]:
    values = fleet(5)
    for week in range(6, COUNT):
        values["07"][week][[2, 3]] += 0.15
    return values


def test_a_drift_with_the_hours_of_use_is_what_they_explain() -> None:
    values = fleet(5)
    for week in range(COUNT):
        values["07"][week][[2, 3]] += 0.012 * week
    arms = {
        arm: [recorded(one, week, operating_hours=3.7 * week) for week, one in enumerate(of_arm)]
        for arm, of_arm in values.items()
    }
    found = change_points(arms, dict.fromkeys(arms, FIT), GROUPS, scatter_of(arms, GROUPS))
    assert not any(one.changed or one.drift for one in found)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_recordings_are_no_trend(count: int) -> None:
    assert changes_of(fleet(5, count=count)) == []


def test_warmth_explains_what_is_no_change() -> None:
    """Friction that falls with the temperature, in a room that a heating warmed up from the sixth week on."""
    values, slope = fleet(5), -0.02
    rng = np.random.default_rng(2)
    arms, plain = {}, {}
    for arm, of_arm in values.items():
        warmth = 20.0 + 8.0 * (np.arange(COUNT) >= 5) + 2.0 * rng.standard_normal(COUNT)
        for week, one in enumerate(of_arm):
            one[0] += slope * (warmth[week] - 20.0)
        arms[arm] = [recorded(one, week, temperature=warmth[week]) for week, one in enumerate(of_arm)]
        plain[arm] = [recorded(one, week) for week, one in enumerate(of_arm)]
    fits = dict.fromkeys(arms, FIT)
    assert any(one.changed for one in change_points(plain, fits, GROUPS, scatter_of(plain, GROUPS)))
    scatter = scatter_of(arms, GROUPS)
    assert not any(one.changed for one in change_points(arms, fits, GROUPS, scatter))
    found = {one.place: one for one in dependences(arms, GROUPS, scatter) if one.condition == "temperature"}
    assert abs(found[0].slope - slope) < 4.0 * found[0].deviation
    assert found[0].p < 1e-6
    assert all(found[place].p > 1e-3 for place in range(1, SIZE))
    assert found[0].recordings == ARMS * COUNT


def test_a_series_has_its_interval() -> None:
    values = fleet(5)
    arms = {arm: [recorded(one, week) for week, one in enumerate(of_arm)] for arm, of_arm in values.items()}
    scatter = scatter_of(arms, GROUPS)
    points = parameter_series(arms["03"], 3, 1, 1, scatter[("friction", 2)])
    np.testing.assert_allclose(points[:, 1], [one[3] for one in values["03"]])
    assert np.all((points[:, 2] > 1.9 * NOISE) & (points[:, 2] < 3.0 * NOISE))
