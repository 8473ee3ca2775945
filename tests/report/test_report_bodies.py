"""Bodies, bounds and friction against what is known of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.random_arms import random_body, random_rotation
from report.conftest import Made
from results.svg import Svg

from ident_service.model.kinematics import frame_origins, link_poses
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.evidence.gathering import bounds_of, ellipsoid, posed
from ident_service.results.report.figures import Figure, bodies_words, body_figures, ellipse


def inertial_of(mass: float, center: np.ndarray, about_center: np.ndarray) -> np.ndarray:
    L = about_center + mass * (center @ center * np.eye(3) - np.outer(center, center))
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(mass * center), mass])


@pytest.mark.parametrize("seed", range(5))
def test_the_half_axes_of_a_solid_ellipsoid_come_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, half, mass, center = random_rotation(rng), np.sort(rng.uniform(0.02, 0.3, 3)), 2.5, rng.normal(size=3)
    # Principal moments of a solid ellipsoid: m (b^2 + c^2) / 5.
    moments = mass / 5.0 * (half @ half - half**2)
    found = ellipsoid(inertial_of(mass, center, R @ np.diag(moments) @ R.T))
    assert found[0] == mass
    np.testing.assert_allclose(found[1], center, atol=1e-12)
    assert found[2] is not None
    np.testing.assert_allclose(np.linalg.norm(found[2], axis=1), half, rtol=1e-9)
    np.testing.assert_allclose(np.abs(found[2] @ R / half[:, None]), np.eye(3), atol=1e-6)


def test_any_real_body_has_an_ellipsoid_of_its_inertia() -> None:
    body = random_body(np.random.default_rng(4))
    mass, center, axes = ellipsoid(body)
    assert axes is not None
    second = mass / 5.0 * axes.T @ axes
    about_center = np.trace(second) * np.eye(3) - second
    np.testing.assert_allclose(inertial_of(mass, center, about_center), body, rtol=1e-9, atol=1e-12)


def test_a_body_that_breaks_the_triangle_inequality_has_none() -> None:
    mass, center, axes = ellipsoid(inertial_of(1.0, np.array([0.1, 0.0, 0.0]), np.diag([1.0, 0.1, 0.1])))
    assert (mass, axes) == (1.0, None)
    np.testing.assert_allclose(center, [0.1, 0.0, 0.0])
    assert ellipsoid(np.zeros(10))[2] is None


def test_the_outline_of_a_sphere_is_a_circle_and_of_an_ellipsoid_its_shadow() -> None:
    np.testing.assert_allclose(np.linalg.norm(ellipse(0.3 * np.eye(3), (0, 2)), axis=1), 0.3)
    shadow = ellipse(np.diag([0.1, 0.2, 0.4]), (0, 2))
    np.testing.assert_allclose(np.abs(shadow).max(axis=0), [0.1, 0.4], rtol=1e-3)


def test_bodies_stand_where_their_links_are(good: Made) -> None:
    model, estimate = good.estimate.model, good.estimate
    posture = np.array([[0.4, -0.9]])
    found = posed(model, estimate.delta, posture)
    assert found is not None
    np.testing.assert_allclose(found.points, frame_origins(model.chain, posture)[0])
    turns, places = link_poses(model.chain, posture)
    np.testing.assert_allclose(places[0], found.points[2::2])
    for link, body in enumerate(found.bodies):
        mass, center, _ = ellipsoid(estimate.delta[model.layout.inertial(link)])
        assert body.mass == mass
        np.testing.assert_allclose(body.center, turns[0, link] @ center + places[0, link])
    np.testing.assert_allclose(turns @ turns.transpose(0, 1, 3, 2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)


def test_the_posture_is_one_of_the_recording(good: Made) -> None:
    assert good.evidence.posed is not None
    recorded = np.concatenate([block.position for block in _recordings(good)])
    origins = frame_origins(good.model.chain, recorded)
    distance = np.abs(origins - good.evidence.posed.points).max(axis=(1, 2))
    assert distance.min() < 0.02


def _recordings(made: Made) -> list:
    from report.conftest import recording

    return list(recording(made.folder.parent, made.model, made.delta, 1).blocks())


def test_margins_are_those_of_the_feasible_set(good: Made) -> None:
    conditions = good.estimate.conditions
    assert [one.name for one in good.evidence.conditions] == [block.name for block in conditions.blocks]
    smallest = min(one.margin for one in good.evidence.conditions)
    assert smallest == pytest.approx(good.estimate.margin, rel=1e-6, abs=1e-9)
    assert {one.links for one in good.evidence.conditions} >= {(0,), (1,)}


def test_a_bound_belongs_to_the_parameter_that_presses_against_it(good: Made) -> None:
    estimate = good.estimate
    name = estimate.conditions.blocks[1].name
    assert name.startswith("link 2")
    bounds = bounds_of((name,), estimate.conditions, estimate.base)
    for names, expression in zip(bounds, estimate.base.expressions, strict=True):
        first = estimate.base.names[estimate.base.base[list(estimate.base.expressions).index(expression)]]
        assert names == ((name,) if first.endswith("2") and not first.startswith(("I", "f")) else ())


def with_ellipsoids(made: Made, first: np.ndarray, center: np.ndarray | None = None) -> Evidence:
    """The evidence with other half axes of the first link's body, and perhaps another centre."""
    posed_ = made.evidence.posed
    assert posed_ is not None
    one, other = posed_.bodies
    kept = replace(one, axes=first, center=one.center if center is None else center)
    bodies = (kept, replace(other, axes=0.05 * np.eye(3)))
    return replace(made.evidence, posed=replace(posed_, bodies=bodies))


def test_an_ellipsoid_larger_than_any_picture_is_named_and_not_drawn(good: Made) -> None:
    joint, flat, small = good.evidence.joints[0], np.diag([2.0, 2.0, 1800.0]), 0.05 * np.eye(3)
    words = bodies_words(with_ellipsoids(good, 0.0005 * np.eye(3)))
    assert "Too small to be seen (shorter than 0.0" in words
    assert f"the ellipsoid of {joint}." in words
    fitting = with_ellipsoids(good, small)
    assert "not drawn" not in bodies_words(fitting)
    assert "Too small" not in bodies_words(fitting)
    words = bodies_words(with_ellipsoids(good, flat))
    assert f"and not drawn: the ellipsoid of {joint} (3600 m). It is one body of many" in words
    assert "--prior" in words
    for whole, figure in zip(body_figures(fitting), body_figures(with_ellipsoids(good, flat)), strict=True):
        assert len(svg_of(whole).points("polygon", "body")) == 2
        assert len(svg_of(figure).points("polygon", "body")) == 1
        assert "--prior" in figure.description


@pytest.mark.parametrize("size", [0.02, 0.3, 0.6, 0.9])
def test_no_ellipsoid_is_cut_off(good: Made, size: float) -> None:
    posed_ = good.evidence.posed
    assert posed_ is not None
    extent = float(np.ptp(posed_.points, axis=0).max())
    axes = extent * np.diag([0.3 * size, size, size])
    for center in (None, posed_.points[-1] + 0.8 * extent):
        for figure in body_figures(with_ellipsoids(good, axes, center)):
            svg = svg_of(figure)
            (frame,) = svg.all("rect", "frame")
            left, top, width, height = (float(frame.get(key, "")) for key in ("x", "y", "width", "height"))
            outlines = svg.points("polygon", "body")
            assert len(outlines) == 2
            for points in (*outlines, *svg.points("polyline", "posture step7")):
                assert left < points[:, 0].min()
                assert points[:, 0].max() < left + width
                assert top < points[:, 1].min()
                assert points[:, 1].max() < top + height


def svg_of(figure: Figure) -> Svg:
    return Svg.of(figure.svg())


def test_friction_points_are_the_friction_that_was_put_in(good: Made) -> None:
    layout = good.model.layout
    fv, fc, fo = (layout.term_values(term, good.delta) for term in ("viscous", "coulomb", "offset"))
    for drive, friction in enumerate(good.evidence.friction):

        def true(velocity: np.ndarray, drive: int = drive) -> np.ndarray:
            return fv[drive] * velocity + fc[drive] * np.sign(velocity) + fo[drive]

        np.testing.assert_allclose(friction.curve_torque, true(friction.curve_velocity), atol=0.05)
        moving = np.abs(friction.velocity) > 0.1
        off = friction.torque[moving] - true(friction.velocity[moving])
        assert moving.sum() > 100
        assert 0.015 < np.std(off) < 0.04
        assert abs(np.mean(off)) < 0.05
        assert (np.diff(friction.curve_velocity) > 0.0).all()
        assert len(friction.terms) == 3


def test_a_model_without_friction_has_none(good: Made) -> None:
    from ident_service.results.evidence.gathering import FrictionCollector

    model = replace(good.estimate.model, layout=replace(good.estimate.model.layout, terms=("drive_inertia",)))
    from ident_service.model.base_parameters import base_parameters

    estimate = replace(good.estimate, model=model, base=base_parameters(model.chain, model.layout))
    assert FrictionCollector(estimate).found() == ()
