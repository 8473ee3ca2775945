"""A payload in a description: what is refused, with its place; and what it adds to the arm's model and bounds."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.config.payload import Payload, constraints_with_payload
from ident_service.errors import ConfigError, ModelError
from ident_service.estimation.feasible.feasible_set import configured_blocks
from ident_service.model.arm_model import arm_model
from ident_service.model.regressor import joint_regressor
from ident_service.motion.after_stop import joints_with_weight
from sim_backend.build import build_machine

Array = np.ndarray
CONFIGS = Path(__file__).parents[2] / "configs"
MASS, CENTER = 0.8, (0.02, -0.03, 0.05)
INERTIA = (2e-3, 1e-4, 0.0, 3e-3, -2e-4, 4e-3)


def arm_file(folder: Path, payload: str, base: str = "planar2") -> Path:
    path = folder / "arm.yaml"
    path.write_text(f"extends: {base}.yaml\nname: loaded\n{payload}\n")
    return path


@pytest.fixture
def shipped(tmp_path: Path) -> Path:
    for source in CONFIGS.glob("*"):
        if source.is_file():
            (tmp_path / source.name).write_bytes(source.read_bytes())
    return tmp_path


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        ("payload: {mass: 0, center_of_mass: [0, 0, 0]}", "3:11: payload.mass: must be greater than 0 [kg]"),
        ("payload: {mass: -1, center_of_mass: [0, 0, 0]}", "3:11: payload.mass: must be greater than 0 [kg]"),
        ("payload: {mass: .nan, center_of_mass: [0, 0, 0]}", "3:11: payload.mass: must be a number [kg]"),
        ("payload: {mass: 2500, center_of_mass: [0, 0, 0]}", "payload.mass: must be at most"),
        ("payload: {center_of_mass: [0, 0, 0]}", "3:1: payload: 'mass' is missing"),
        ("payload: {mass: 1}", "3:1: payload: 'center_of_mass' is missing"),
        ("payload: {mass: 1, center_of_mass: [0, 0, 120]}", "120 m is more than 3 m from the link's"),
        ("payload: {mass: 1, center_of_mass: [0, 0]}", "payload.center_of_mass"),
        ("payload: {mass: 1, center_of_mass: [0, 0, 0], centre: 3}", "unknown key 'centre'"),
        (
            "payload: {mass: 1, center_of_mass: [0, 0, 0], inertia: [1, 0, 0, 1, 0, 3]}",
            "no body has principal moments of 1, 1 and 3 kg m^2",
        ),
        (
            "payload: {mass: 1, center_of_mass: [0, 0, 0], inertia: [1, 2, 0, 1, 0, 1]}",
            "no body has principal moments of -1, 1 and 3 kg m^2",
        ),
        ("payload: {mass: 1, center_of_mass: [0, 0, 0], link: hand}", "'hand' is none of shoulder, elbow"),
    ],
)  # fmt: skip
def test_what_no_payload_is_is_refused_with_its_place(shipped: Path, payload: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_arm(arm_file(shipped, payload))
    assert said in str(caught.value)
    assert re.search(r"arm\.yaml:3:\d+: payload", str(caught.value))


def test_a_link_of_a_urdf_that_is_none_is_named(shipped: Path) -> None:
    config = load_arm(arm_file(shipped, "", "threelink"))
    loaded = config.model_copy(
        update={"joints": {}, "payload": Payload(mass=1.0, center_of_mass=(0.0, 0.0, 0.0), link="tool0")}
    )
    with pytest.raises(ModelError, match=r"payload\.link: 'tool0' is none of"):
        arm_model(loaded)


def loaded_and_bare(shipped: Path, more: str = "") -> tuple[ArmConfig, ArmConfig]:
    text = f"payload: {{mass: {MASS}, center_of_mass: {list(CENTER)}, inertia: {list(INERTIA)}{more}}}"
    return load_arm(arm_file(shipped, text)), load_arm("planar2")


@pytest.mark.parametrize(("more", "link"), [("", 1), (", link: elbow", 1), (", link: shoulder", 0)])
def test_it_is_a_body_on_its_link_in_the_prior_and_in_the_simulated_arm(shipped: Path, more: str, link: int) -> None:
    config, bare = loaded_and_bare(shipped, more)
    model, alone = arm_model(config), arm_model(bare)
    assert model.prior is not None
    assert alone.prior is not None
    c = np.array(CENTER)
    xx, xy, xz, yy, yz, zz = INERTIA
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    L = J + MASS * (c @ c * np.eye(3) - np.outer(c, c))  # Steiner
    expected = [L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(MASS * c), MASS]
    added = model.prior - alone.prior
    np.testing.assert_allclose(added[model.layout.inertial(link)], expected, atol=1e-12)
    assert np.count_nonzero(added) == np.count_nonzero(expected)
    rng = np.random.default_rng(0)
    q, v, a = rng.normal(size=(3, 2))
    H = joint_regressor(model.chain, model.layout, q[None], v[None], a[None])[:, :, 0]
    more_torque = build_machine(config).plant.inverse_dynamics(q, v, a) - build_machine(bare).plant.inverse_dynamics(
        q, v, a
    )
    np.testing.assert_allclose(more_torque, H @ added, atol=1e-10)


def test_bounds_of_masses_are_those_of_the_arm_with_it(shipped: Path) -> None:
    config, bare = loaded_and_bare(shipped)
    model, layout = arm_model(config), arm_model(config).layout
    index = {name: column for column, name in enumerate(layout.names)}
    names = [block.name for block in configured_blocks(config, (1, 2), index)]
    assert "total mass at most 4.8 kg" in names
    assert "link 1: centre of mass inside its box" in names
    assert "link 2: centre of mass inside its box" not in names  # the box is that of the link alone
    assert [b.name for b in configured_blocks(bare, (1, 2), index)].count("link 2: centre of mass inside its box") == 1
    joints = dict(config.joints)
    body = joints["elbow"].body.model_copy(update={"mass": (0.5, 1.5)})
    joints["elbow"] = joints["elbow"].model_copy(update={"body": body})
    said = constraints_with_payload(config.model_copy(update={"joints": joints})).joints["elbow"].body.mass
    assert said == (1.3, 2.3)
    assert model.prior is not None
    assert model.prior[index["m2"]] == pytest.approx(1.8)


def test_it_counts_in_what_falls_and_in_what_a_motion_was_checked_for(shipped: Path) -> None:
    config, bare = loaded_and_bare(shipped)
    assert config.motion_sha256 != bare.motion_sha256
    assert config.model_copy(update={"payload": None, "name": bare.name}).sha256 == bare.sha256
    light = load_arm("planar2")
    limits = motion_limits(light)
    model = arm_model(light)
    assert model.prior is not None
    # An elbow whose link weighs nothing falls because of what it carries.
    prior = model.prior.copy()
    prior[model.layout.inertial(1)] = [*([1e-9] * 6), 0.0, 0.0, 0.0, 1e-6]
    assert joints_with_weight(replace(model, prior=prior), limits) == ("shoulder",)
    loaded = prior.copy()
    loaded[model.layout.inertial(1)] += Payload(mass=MASS, center_of_mass=CENTER).parameters
    assert joints_with_weight(replace(model, prior=loaded), limits) == ("shoulder", "elbow")


def test_descriptions_without_one_keep_their_hash() -> None:
    """Motions and results name a description by its hash."""
    document = load_arm("planar2").model_dump_json()
    assert "payload" not in document
