"""Common model and deviations of arms: recovered from known ones, unlike arms found, pooling judged on unseen data."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fleets import Kind, held_out_errors, kind, write_recording

from ident_service import __version__
from ident_service.estimation.least_squares import ordinary_least_squares, torque_error
from ident_service.estimation.uncertainty import Uncertainty
from ident_service.fleet import arm_results
from ident_service.fleet.arm_page import ArmShown
from ident_service.fleet.arm_results import ArmFits, Leaves
from ident_service.fleet.factor import Described, Merged, Part, Row, Settled, merge_stored, reduce_recording, settle
from ident_service.fleet.population import (
    ArmFit,
    HeldOut,
    Population,
    arm_fit,
    pooled_fit,
    population,
    unlike,
    variance_shares,
)
from ident_service.fleet.storage import Store, find_files
from ident_service.model.information import Information, triangle

ARMS, TOOL = 10, 7


@pytest.fixture(scope="module")
def usual() -> Kind:
    return kind(rate=100.0, seconds=10.0, noise=0.3)


@pytest.fixture(scope="module")
def truths(usual: Kind) -> list[np.ndarray]:
    """Ten arms that differ by 2 %; one carries 0.5 kg more at its flange."""
    found = [usual.individual(arm, 0.02) for arm in range(ARMS)]
    names = usual.model.layout.names
    for name, more in (("m2", 0.5), ("lx2", 0.02), ("Lxx2", 1e-3), ("Lyy2", 2e-3), ("Lzz2", 2e-3)):
        found[TOOL][names.index(name)] += more
    return found


@pytest.fixture(scope="module")
def fleet(usual: Kind, truths: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Row]]:
    """Two recordings of each arm, of which the first of arm 0 lasts 3.2 s."""
    place = tmp_path_factory.mktemp("population")
    for arm, delta in enumerate(truths):
        for number in range(2):
            seconds = 3.2 if (arm, number) == (0, 0) else None
            write_recording(usual, place / f"{arm}-{number}.mcap", delta, seed=10 * arm + number, seconds=seconds)
    sources = find_files([str(place)])
    settled = settle(sources[2:4], usual.model.config.model_dump_json())
    assert isinstance(settled, Settled)
    global DESCRIBED, STORE
    DESCRIBED, STORE = Described(settled.description), Store(str(place / "store"))
    rows: dict[str, list[Row]] = {}
    for source in sources:
        outcome = reduce_recording(Part(source), DESCRIBED, STORE, __version__)
        assert outcome.row is not None, outcome.problem
        rows.setdefault(source.name[0], []).append(outcome.row)
    return rows


DESCRIBED: Described
STORE: Store


def merged(*rows: Row) -> Merged:
    found = merge_stored([row.key for row in rows], DESCRIBED, STORE, cluster_by_recording=False)
    assert isinstance(found, Merged)
    return found


@pytest.fixture(scope="module")
def fits(fleet: dict[str, list[Row]]) -> dict[str, ArmFit]:
    return {arm: arm_fit(merged(*rows), "wls") for arm, rows in fleet.items()}


@pytest.fixture(scope="module")
def found(fits: dict[str, ArmFit]) -> Population:
    return population(fits, DESCRIBED.groups)


@pytest.mark.slow
def test_the_common_model_is_the_mean_of_the_arms(found: Population, usual: Kind, truths: list[np.ndarray]) -> None:
    mean = np.mean([usual.base.K @ delta for delta in truths], axis=0)
    known = np.sqrt(np.diag(found.covariance)) * found.scale
    assert np.all(np.abs(found.common - mean) < 4.0 * known + 2.0 * found.between / np.sqrt(ARMS))


def test_the_spread_between_arms_is_that_of_their_bodies(
    found: Population, usual: Kind, truths: list[np.ndarray]
) -> None:
    base = np.array([usual.base.K @ delta for delta in truths])
    for group, places in DESCRIBED.groups.items():
        spread = np.sqrt(np.mean(np.var(base[:, list(places)], axis=0, ddof=1) / found.scale[list(places)] ** 2))
        if spread > 0.05:  # N m, beyond the noise of ten arms
            assert 0.5 * spread < found.tau[group] < 2.0 * spread, group


def test_pooled_estimates_are_nearer_to_the_truth(
    fits: dict[str, ArmFit], found: Population, usual: Kind, truths: list[np.ndarray]
) -> None:
    def far(beta: np.ndarray, arm: str) -> float:
        return float(np.linalg.norm((beta - usual.base.K @ truths[int(arm)]) / found.scale))

    ordinary = [arm for arm in fits if int(arm) != TOOL]
    alone = [far(fits[arm].fit.beta, arm) for arm in ordinary]
    pooled = [far(pooled_fit(fits[arm], found.other_arms(arm), found.scale).beta, arm) for arm in ordinary]
    assert np.sqrt(np.mean(np.square(pooled))) < np.sqrt(np.mean(np.square(alone)))


def test_an_arms_precision_is_neither_too_large_nor_too_small(
    fleet: dict[str, list[Row]], usual: Kind, truths: list[np.ndarray]
) -> None:
    """Also from one recording, whose dozen blocks say little of each parameter's variance by itself."""
    squares = []
    for arm, rows in fleet.items():
        beta = usual.base.K @ truths[int(arm)]
        for one in rows:
            fit = arm_fit(merged(one), "wls")
            off = fit.fit.beta - beta
            squares.append(off @ fit.precision @ off / len(off))
    assert 0.5 < np.mean(squares) < 2.5
    assert max(squares) < 8.0


def test_no_recording_is_sure_of_itself_by_chance(
    fleet: dict[str, list[Row]], usual: Kind, truths: list[np.ndarray]
) -> None:
    """Offsets, of which a drive's friction has one, are what few blocks of a short motion are wrong about."""
    numbers = {group: number for number, group in enumerate(DESCRIBED.groups)}
    z = []
    for arm, rows in fleet.items():
        beta = usual.base.K @ truths[int(arm)]
        for one in rows:
            for group, places in DESCRIBED.groups.items():
                covariance = one.covariances[numbers[group]]
                off = (one.beta - beta)[list(places)]
                z.append(off @ np.linalg.solve(covariance, off) / len(off))
    assert np.quantile(z, 0.99) < 8.0
    assert max(z) < 10.0


def test_a_parameter_that_all_arms_share_does_not_hide_how_they_differ_in_others_of_its_group() -> None:
    """The first is the same in all arms and known well; the second is known to little less than it differs."""
    rng, size, arms, spread = np.random.default_rng(4), 3, 40, 0.08
    rows = rng.standard_normal((400, size))
    R = triangle(np.column_stack([rows, rows @ np.ones(size) + 0.05 * rng.standard_normal(400)]))
    total = Information((np.arange(size),), (R,), np.array([400]), size)
    usual_fit = ordinary_least_squares(total)
    error, doubt = torque_error(total, usual_fit.beta), np.array([0.004, 0.05, 0.02])
    nothing = Uncertainty(np.diag(doubt**2), doubt, np.full(size, 50.0))
    fits = {}
    for arm in range(arms):
        beta = 1.0 + np.array([0.0, spread, 0.02]) * rng.standard_normal(size) + doubt * rng.standard_normal(size)
        fit = replace(usual_fit, beta=beta)
        fits[str(arm)] = ArmFit(fit, nothing, 12, np.diag(doubt**-2.0), total, error)
    found = population(fits, {("first moments", 1): (0, 1), ("friction", 1): (2,)})
    assert 0.6 * spread < found.between[1] < 1.6 * spread
    assert found.between[0] < 0.5 * spread


def test_with_much_data_an_arm_stays_itself(fits: dict[str, ArmFit], found: Population) -> None:
    one = fits["3"]
    sure = ArmFit(one.fit, one.doubt, one.clusters, 1e6 * one.precision, one.total, one.error)
    pooled = pooled_fit(sure, found.other_arms("3"), found.scale)
    np.testing.assert_allclose(pooled.beta / found.scale, one.fit.beta / found.scale, atol=0.02)


def test_the_arm_with_a_tool_is_the_most_unlike(fits: dict[str, ArmFit], found: Population) -> None:
    leading = tuple(DESCRIBED.base.names[column] for column in DESCRIBED.base.base)
    every = unlike(fits, found, DESCRIBED.groups, leading)
    assert len(every) == ARMS * len(DESCRIBED.groups)
    best = min(every, key=lambda one: one.p)
    assert best.arm == str(TOOL)
    assert best.p < 0.01
    assert best.group[0] in ("first moments", "inertia")
    assert {one.arm for one in every if one.p < 0.01} == {str(TOOL)}


def test_two_arms_are_too_few_to_call_one_unlike(fits: dict[str, ArmFit]) -> None:
    two = {arm: fits[arm] for arm in ("1", "2")}
    assert unlike(two, population(two, DESCRIBED.groups), DESCRIBED.groups, ()) == []


def test_one_arm_alone_is_a_fleet(fits: dict[str, ArmFit]) -> None:
    alone = population({"1": fits["1"]}, DESCRIBED.groups)
    assert np.all(np.isfinite(alone.common))


def test_shares_of_variance_are_those_that_were_drawn() -> None:
    rng = np.random.default_rng(3)
    arms, recordings, noise = 4.0, 1.0, 0.25
    rows = {}
    for arm in range(300):
        level = np.sqrt(arms) * rng.standard_normal()
        beta = level + np.sqrt(recordings) * rng.standard_normal(6) + np.sqrt(noise) * rng.standard_normal(6)
        rows[str(arm)] = [row(value, noise) for value in beta]
    found = variance_shares(rows, {("friction", 1): (0,)})
    assert found.arms[0] == pytest.approx(arms, rel=0.2)
    assert found.recordings[0] == pytest.approx(recordings, rel=0.2)
    assert found.noise[0] == noise
    assert found.percent[0].sum() == pytest.approx(100.0)


def row(value: float, variance: float) -> Row:
    one = np.array([value])
    return Row("k", "s", "", 0.0, 1.0, 1.0, one, one, (np.array([[variance]]),), 12, one, one, 1.0, 0, 0.0, (), {})


def test_pooling_helps_an_arm_with_one_short_recording(fleet: dict[str, list[Row]], fits: dict[str, ArmFit]) -> None:
    told = population(
        {arm: one for arm, one in fits.items() if arm != "0"} | {"0": arm_fit(merged(fleet["0"][0]), "wls")},
        DESCRIBED.groups,
    )
    short, unseen = merged(fleet["0"][0]), merged(fleet["0"][1])
    alone, pooled = held_out_errors(arm_fit(short, "wls"), unseen, told.other_arms("0"), told.scale, DESCRIBED)
    # What noise leaves is in both; beyond it, most of the error is gone.
    left = arm_fit(unseen, "wls").error.relative_percent
    excess = [np.sqrt(max(error**2 - left**2, 0.0)) for error in (alone, pooled)]
    assert excess[1] < 2.0 / 3.0 * excess[0]


def test_what_follows_from_an_arms_factors_is_made_once(
    fleet: dict[str, list[Row]], found: Population, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Other arms may change what is said of it, and a damaged file is made again; nothing else is computed twice."""
    rows = sorted(fleet["3"], key=lambda one: one.sha256)
    leaves, names = Leaves.of([one.key for one in rows]), [(f"{one.label}w", one.sha256) for one in rows]
    assert (leaves.count, leaves.by_recording) == (1, False)
    store, config = Store(str(tmp_path)), DESCRIBED.config.model_dump_json()
    for folder in ("factors", "rows"):
        shutil.copytree(Path(STORE.url, folder), tmp_path / folder)
    between = np.zeros(DESCRIBED.base.size)
    shown = ArmShown("3", [("one", "2026-01-01 00:00", 12.0, 100.0, 2.0, "")], [])

    def made(arms: int, pooled: bool = False) -> tuple[ArmFits, Any, dict[str, bytes], dict[str, Any]]:
        fits = arm_results.arm_fits(leaves, DESCRIBED, store, between)
        assert isinstance(fits, ArmFits)
        errors = arm_results.errors_held_out(fits, "3", found, DESCRIBED)
        more = {"arm": "3", "pooled": pooled, "arms": arms, "held_out_percent": None}
        return fits, errors, *arm_results.arm_files(fits, names, DESCRIBED, found, config, more, store, shown)

    first, errors, files, summary = made(10)
    assert first.merged is not None
    assert sorted("".join(path.suffixes) for path in (tmp_path / "results").iterdir()) == [
        *(".fit.npz", ".fit.npz", ".held.npz", ".zip")
    ]
    single, held = merged(rows[0]), merged(rows[1])
    assert errors[1] == pytest.approx(
        held_out_errors(arm_fit(single, "wls").weighed(between), held, found.other_arms("3"), found.scale, DESCRIBED)
    )

    def again(*_: object, **__: object) -> None:
        raise AssertionError("computed again")

    with monkeypatch.context() as patched:
        for name in ("arm_fit", "arm_estimate", "merge_stored"):
            patched.setattr(arm_results, name, again)
        second, same_errors, same, told = made(10)
        assert second.merged is None
        assert same_errors == errors
        assert same == files
        assert {**told, "negligible": None} == {**summary, "negligible": None}
        np.testing.assert_array_equal(second.fit.precision, first.fit.precision)
        np.testing.assert_array_equal(told["negligible"], summary["negligible"])
        other = json.loads(made(11)[2]["parameters.json"])
        assert (other["fleet"]["arms"], other["base_parameters"]) == (
            11,
            json.loads(files["parameters.json"])["base_parameters"],
        )
        with pytest.raises(AssertionError, match="computed again"):
            made(10, pooled=True)
    assert made(10, pooled=True)[0].merged is None, "merged for its estimate alone"
    for path in (tmp_path / "results").iterdir():
        path.write_bytes(path.read_bytes()[:100])
    _, _, mended, _ = made(10)
    assert set(mended) == set(files)
    assert mended["report.txt"] == files["report.txt"]


def test_factors_that_are_gone_are_named(fleet: dict[str, list[Row]], tmp_path: Path) -> None:
    store, keys = Store(str(tmp_path)), [one.key for one in fleet["3"]]
    for key in keys[1:]:
        store.write(f"factors/{key}.npz", Path(STORE.url, "factors", f"{key}.npz").read_bytes())
    found = arm_results.arm_fits(Leaves.of(keys), DESCRIBED, store, np.zeros(DESCRIBED.base.size))
    assert found == (keys[0],)
    assert arm_results.reported_fits(found) == (keys[0],)


def test_pooling_is_judged_by_its_gain() -> None:
    assert HeldOut({"a": 3.0, "b": 4.0}, {"a": 1.5, "b": 2.0}).gain == pytest.approx(0.5)
    assert HeldOut({"a": 3.0}, {"a": 2.0}).helps
    assert not HeldOut({"a": 3.0}, {"a": 2.99}).helps
    assert not HeldOut({"a": 3.0}, {"a": 4.0}).helps
    assert not HeldOut({}, {}).helps


def test_the_fixture_has_the_short_recording(fleet: dict[str, list[Row]], tmp_path: Path) -> None:
    assert fleet["0"][0].seconds < 4.0 < fleet["0"][1].seconds
