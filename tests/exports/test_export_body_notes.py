"""Link values are one body of many: every file with them says so, and names those that no arm has."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
from exports.export_bench import identified, true_arm

from ident_service.results.export.bodies import about_origin
from ident_service.results.export.formats import arm_reach, body_notes, export_texts

LINKS = ["urdf", "mjcf", "sdf", "json"]


def test_every_file_with_link_values_says_that_they_are_one_of_many() -> None:
    arm = true_arm("planar2")
    verdicts = ("unidentified", "unidentified", *arm.verdicts[2:])
    arm = dataclasses.replace(arm, verdicts=verdicts)
    first, *rest = body_notes(arm)
    assert first.startswith("link values are one feasible body of many with the same torques")
    assert "option prior of ident identify" in first
    assert first.endswith(f"2 of {arm.base.size} base parameters are unidentified")
    assert rest == []
    for one in export_texts(arm, LINKS):
        assert first in one.notes
        assert first.replace("_", " ") in one.text.replace("_", " ")
    assert first in export_texts(arm, ["csv"])[0].notes
    assert export_texts(arm, ["c"])[0].notes == ()
    assert body_notes(dataclasses.replace(arm, delta=None)) == ()


def test_a_prior_that_was_used_is_not_recommended() -> None:
    arm = true_arm("planar2")
    settings = arm.model.config.identification
    settings = settings.model_copy(update={"prior": settings.prior.model_copy(update={"kind": "entropic"})})
    model = dataclasses.replace(arm.model, config=arm.model.config.model_copy(update={"identification": settings}))
    assert "(regularised towards the prior parameters)" in body_notes(dataclasses.replace(arm, model=model))[0]


def test_links_that_no_arm_has_are_named() -> None:
    model = true_arm("planar2").model
    assert arm_reach(model) == 1.0
    delta = np.zeros(model.layout.size)
    delta[model.layout.inertial(0)] = about_origin(9e-4, np.zeros(3), 1e-6 * np.eye(3))
    # Seen from the second joint, 1.05 m away; the link's frame lies at its far end.
    center = model.chain.link_rotation[1].T @ (np.array([0.0, 1.05, 0.0]) - model.chain.link_translation[1])
    delta[model.layout.inertial(1)] = about_origin(1.0, center, 1e-3 * np.eye(3))
    arm = identified(model, delta)
    _, light, far = body_notes(arm)
    assert light == "implausible: the link of shoulder has a mass of 0.0009 kg"
    assert far == (
        "implausible: the link of elbow has its centre of mass 1.05 m from its joint, and the arm reaches 1 m"
    )
    assert json.loads(export_texts(arm, ["json"])[0].text)["notes"][1:] == [light, far]
