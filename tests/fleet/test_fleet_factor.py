"""Factors of single recordings: merged they say what all recordings together say; bad recordings become problems."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.fleets import BEGIN, WEEK, Kind, kind, samples, write_recording, write_samples

from ident_service import __version__
from ident_service.errors import UsageError
from ident_service.estimation.equations import equations
from ident_service.estimation.least_squares import weighted_least_squares
from ident_service.fleet.factor import (
    FACTORS,
    MOST_CLUSTERS,
    ROWS,
    Described,
    Merged,
    Outcome,
    Part,
    Row,
    Settled,
    merge,
    merge_stored,
    packed,
    reduce_recording,
    require_mergeable,
    settle,
    unpacked,
)
from ident_service.fleet.storage import Store, find_files
from ident_service.operations.recordings import open_for_arm
from ident_service.recordings.mcap_writer import RecordingWriter


@pytest.fixture(scope="module")
def usual() -> Kind:
    return kind(rate=100.0, seconds=15.0)


@pytest.fixture(scope="module")
def folder(usual: Kind, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("recordings")
    for number in range(3):
        said = {"temperature_celsius": f"{20 + number}", "operating_hours": f"{100 * number}"}
        path = place / f"{number}.mcap"
        write_recording(usual, path, usual.truth, seed=number, at=BEGIN + number * WEEK, metadata=said)
    return place


@pytest.fixture(scope="module")
def described(usual: Kind, folder: Path) -> Described:
    settled = settle(find_files([str(folder)]), usual.model.config.model_dump_json())
    assert isinstance(settled, Settled)
    assert len(settled.pilots) == 3
    return Described(settled.description)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return Store(str(tmp_path_factory.mktemp("store")))


@pytest.fixture(scope="module")
def rows(folder: Path, described: Described, store: Store) -> list[Row]:
    outcomes = [reduced(path, described, store) for path in sorted(folder.glob("*.mcap"))]
    assert all(one.row is not None and one.computed for one in outcomes), outcomes
    return [one.row for one in outcomes if one.row is not None]


def reduced(path: Path, described: Described, store: Store, **more: bool) -> Outcome:
    (source,) = find_files([str(path)])
    return reduce_recording(Part(source), described, store, __version__, **more)


def test_recordings_that_cannot_be_fitted_together_are_all_named(usual: Kind, tmp_path: Path) -> None:
    """An unreadable file before them has its own reason and is not named for theirs."""
    (tmp_path / "0.mcap").write_bytes(b"no recording")
    position, _, torque = samples(usual, usual.truth, seed=0)
    rest = np.zeros_like(position)
    for name in ("1.mcap", "2.mcap"):
        with RecordingWriter(tmp_path / name, usual.model.chain.names, "", round(BEGIN * 1e9)) as writer:
            write_samples(writer, round(BEGIN * 1e9), usual.stamps(len(rest)), rest, rest, np.ones_like(torque))
    problems = settle(find_files([str(tmp_path)]), usual.model.config.model_dump_json())
    assert not isinstance(problems, Settled)
    unreadable, at_rest = problems
    assert unreadable.url == str(tmp_path / "0.mcap")
    assert at_rest.url == f"{tmp_path / '1.mcap'}, {tmp_path / '2.mcap'}"
    assert "never faster than" in at_rest.message


def test_settled_choices_are_numbers(described: Described) -> None:
    options = described.config.identification
    assert options.method == "wls"
    assert isinstance(options.delay, float)
    assert "fit" not in (options.friction.presliding, options.friction.stribeck_velocity)
    assert "choose" not in (options.edge, *options.smoothing.model_dump().values())


def test_merged_factors_are_the_equations_of_all_recordings(
    rows: list[Row], folder: Path, described: Described, store: Store
) -> None:
    merged = merge_stored([row.key for row in rows], described, store, cluster_by_recording=False)
    assert isinstance(merged, Merged)
    recordings = [open_for_arm(path, described.model) for path in sorted(folder.glob("*.mcap"))]
    together = equations(recordings, described.model, described.base)
    assert merged.samples == together.samples
    np.testing.assert_array_equal(merged.everything.rows, together.everything.rows)
    ours, theirs = (weighted_least_squares(one.everything).beta for one in (merged, together))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)


def test_rows_tell_estimate_time_conditions_and_noise(rows: list[Row], usual: Kind) -> None:
    beta = usual.base.K @ usual.truth
    for number, row in enumerate(rows):
        assert row.stamp == pytest.approx(BEGIN + number * WEEK, abs=1.0)
        assert row.conditions == {"temperature": 20.0 + number, "operating_hours": 100.0 * number}
        assert row.seconds == pytest.approx(15.0, abs=0.1)
        known = np.isfinite(row.deviations)
        assert known.sum() > 0.8 * len(beta)
        assert np.all(np.abs(row.beta - beta)[known] < 6.0 * row.deviations[known])
        again = Row.from_json(row.to_json())
        assert again.to_json() == row.to_json()
    for wrong in (None, 1):
        with pytest.raises(ValueError, match="no row"):
            Row.from_json(json.dumps(json.loads(rows[0].to_json()) | {"warnings": wrong}).encode())


def test_factors_survive_the_file_bit_for_bit(rows: list[Row], described: Described, store: Store) -> None:
    content = store.read(f"{FACTORS}/{rows[0].key}.npz")
    assert content is not None
    factor = unpacked(content, described)
    assert packed(factor) == content
    assert len(content) < 300_000


def test_what_is_in_the_store_is_not_computed_again(
    folder: Path, rows: list[Row], described: Described, store: Store
) -> None:
    outcome = reduced(folder / "0.mcap", described, store)
    assert not outcome.computed
    assert outcome.row is not None
    assert outcome.row.to_json() == rows[0].to_json()


def test_another_description_has_other_factors(
    folder: Path, rows: list[Row], described: Described, store: Store
) -> None:
    config = described.config
    options = config.identification.model_copy(update={"block": 2.0})
    other = Described(config.model_copy(update={"identification": options}).model_dump_json())
    outcome = reduced(folder / "0.mcap", other, store)
    assert outcome.computed
    assert outcome.row is not None
    assert outcome.row.key != rows[0].key


def test_a_damaged_factor_is_named_and_can_be_made_again(
    folder: Path, rows: list[Row], described: Described, store: Store
) -> None:
    name = f"{FACTORS}/{rows[1].key}.npz"
    content = store.read(name)
    assert content is not None
    keys = [row.key for row in rows]
    for broken in (content[:1000], content[:3000] + b"\xff" + content[3001:], b""):
        store.write(name, broken)
        found = merge_stored(keys, described, store, cluster_by_recording=False)
        assert merge([found]) == (rows[1].key,)
    assert reduced(folder / "1.mcap", described, store, recompute=True).computed
    assert store.read(name) == content
    assert isinstance(merge_stored(keys, described, store, cluster_by_recording=False), Merged)


def test_a_damaged_row_is_computed_again(folder: Path, rows: list[Row], described: Described, store: Store) -> None:
    name = f"{ROWS}/{rows[2].key}.json"
    store.write(name, b'{"key": 1')
    assert reduced(folder / "2.mcap", described, store).computed
    assert store.read(name) == rows[2].to_json()


def test_the_tree_keeps_few_clusters(rows: list[Row], described: Described, store: Store) -> None:
    one = merge_stored([rows[0].key], described, store, cluster_by_recording=False)
    assert isinstance(one, Merged)
    whole = merge_stored([rows[0].key], described, store, cluster_by_recording=True)
    assert isinstance(whole, Merged)
    assert len(whole.clusters) == 1
    many = merge([one] * 20)
    assert isinstance(many, Merged)
    assert len(many.clusters) <= MOST_CLUSTERS
    np.testing.assert_array_equal(many.fitted.total.rows, 20 * one.fitted.total.rows)


def test_pieces_of_a_recording_say_together_what_it_says(folder: Path, described: Described, store: Store) -> None:
    (source,) = find_files([f"{folder}/0.mcap"])
    parts = [reduce_recording(Part(source, number, 2), described, store, __version__) for number in range(2)]
    found = [one.row for one in parts if one.row is not None]
    assert [row.label for row in found] == ["#1of2", "#2of2"]
    assert sum(row.seconds for row in found) == pytest.approx(15.0, abs=0.1)
    pieces = merge_stored([row.key for row in found], described, store, cluster_by_recording=False)
    whole = merge_stored([described.key(found[0].sha256, Part(source))], described, store, cluster_by_recording=False)
    assert isinstance(pieces, Merged)
    assert isinstance(whole, Merged)
    # But for the edges of the filter at the cut.
    assert 0.9 * whole.samples < pieces.samples < whole.samples


def test_bad_recordings_become_problems(
    folder: Path, usual: Kind, described: Described, store: Store, tmp_path: Path
) -> None:
    good = (folder / "0.mcap").read_bytes()
    bad = {
        "truncated.mcap": (good[: len(good) // 2], "cut off or damaged"),
        "corrupt.mcap": (good[:8] + bytes(len(good) - 8), "before the damage"),
        "empty.mcap": (b"", "is empty"),
        "foreign.csv": (b"t,q1,q2,q3,tau1,tau2,tau3\n0,0,0,0,0,0,0\n0.01,0,0,0,0,0,0\n", "joints"),
        "noise.bin": (b"\x00\x01\x02" * 100, "neither MCAP nor CSV"),
    }
    for name, (content, words) in bad.items():
        (tmp_path / name).write_bytes(content)
        outcome = reduced(tmp_path / name, described, store)
        assert outcome.row is None, name
        assert outcome.problem is not None
        assert outcome.problem.kind == "recording"
        assert words in outcome.problem.message
        assert outcome.problem.url.endswith(name)


def test_a_condition_that_is_no_number_is_named(
    usual: Kind, described: Described, store: Store, tmp_path: Path
) -> None:
    path = write_recording(usual, tmp_path / "x.mcap", usual.truth, seed=9, metadata={"temperature_celsius": "warm"})
    problem = reduced(path, described, store).problem
    assert problem is not None
    assert "temperature_celsius is 'warm', not a number" in problem.message


def test_a_worker_of_another_version_says_so(folder: Path, described: Described, store: Store) -> None:
    (source,) = find_files([f"{folder}/0.mcap"])
    outcome = reduce_recording(Part(source), described, store, "0.0.0")
    assert outcome.problem is not None
    assert outcome.problem.kind == "version"
    assert "0.0.0" in outcome.problem.message


def test_estimates_that_need_all_recordings_at_once_are_refused(usual: Kind) -> None:
    config = usual.model.config
    options = config.identification.model_copy(update={"method": "iv"})
    with pytest.raises(UsageError, match="method: iv looks at all recordings"):
        require_mergeable(config.model_copy(update={"identification": options}))
