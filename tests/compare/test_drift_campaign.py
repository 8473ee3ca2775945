"""How often an arm that has not changed is called changed, and how often a drier joint is found, on simulated arms."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.changed_arms import COARSE, changed, recorded_arm

from ident_service.config.arm import ArmConfig
from ident_service.estimation.identify import identify
from ident_service.model.arm_model import arm_model
from ident_service.results.comparison.comparison import ComparedSet, Pair, compare, findings, read_side
from ident_service.results.parameter_file import parameters_document, write_parameters

SEEDS = 20
DRIER = {"fv2": 1.3, "fc2": 1.3}


def side(folder: Path, name: str, config: ArmConfig) -> ComparedSet:
    recording = recorded_arm(config, folder / f"{name}.mcap")
    write_parameters(folder / f"{name}.json", parameters_document(identify(arm_model(config), [recording])))
    return read_side(folder / f"{name}.json")


def pairs(folder: Path, seeds: int, first: int, factors: dict[str, float], motion: int | None = None) -> list[Pair]:
    """The accepted arm against as many later ones, each with noise (and a motion, if one is given) of its own."""
    accepted = side(folder, "accepted", changed("planar2", seed=first))
    later = [
        side(
            folder,
            f"later{k}",
            changed("planar2", seed=first + 1 + k, factors=factors, motion=None if motion is None else motion + k),
        )
        for k in range(seeds)
    ]
    return list(compare([accepted, *later]).pairs)


def drier_elbow(pair: Pair) -> bool:
    return [finding.what for finding in findings(pair)] == ["friction of joint elbow"]


@pytest.mark.campaign
@pytest.mark.slow
def test_an_unchanged_and_a_drier_arm_after_another_motion(commissioned: Path, tmp_path: Path) -> None:
    accepted = read_side(commissioned / "accepted")
    same = side(tmp_path, "same", changed("planar2", rate=COARSE, seed=101, motion=1000))
    drier = side(tmp_path, "drier", changed("planar2", rate=COARSE, seed=102, motion=1001, factors=DRIER))
    unchanged, changed_one = compare([accepted, same, drier]).pairs
    assert (unchanged.verdict, changed_one.verdict) == ("unchanged", "changed")
    assert drier_elbow(changed_one)


@pytest.mark.campaign
@pytest.mark.parametrize("motion", [None, 1000], ids=["same motion", "another motion"])
def test_unchanged_arms_are_called_unchanged(tmp_path: Path, motion: int | None) -> None:
    found = pairs(tmp_path, SEEDS, 200, {}, motion)
    assert sum(pair.verdict == "changed" for pair in found) <= 1


@pytest.mark.campaign
@pytest.mark.parametrize("motion", [None, 1000], ids=["same motion", "another motion"])
def test_drier_arms_are_found(tmp_path: Path, motion: int | None) -> None:
    found = pairs(tmp_path, SEEDS, 300, DRIER, motion)
    assert sum(drier_elbow(pair) for pair in found) >= SEEDS - 1
