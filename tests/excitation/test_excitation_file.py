"""The file of a motion: exact to the last bit, and whatever else it may contain refused with a reason."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.examples import some
from hypothesis import example, given, settings
from hypothesis import strategies as st
from motions import random_path

from ident_service.errors import UsageError
from ident_service.excitation.motion_file import Excitation, excitation_from_json, read_excitation
from ident_service.excitation.trajectory import FourierPath, PosturePath

SHA = "ab" * 32
SEEDS = st.integers(0, 2**32 - 1)
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([10**400, -(10**400), 1e308, 1e-308, 5e-324, -0.0, 0])
    | st.floats()
    | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


def content_of(seed: int) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(Excitation("identification", random_path(seed), SHA).to_json())
    return content


@given(seed=SEEDS)
def test_the_file_repeats_the_motion_to_the_last_bit(seed: int) -> None:
    path = random_path(seed, joints=3)
    motion = Excitation("identification", path, SHA, {"seed": 3, "bounds": {"torque": [0.1, 1e-300]}})
    again = excitation_from_json(motion.to_json())
    assert (again.name, again.arm_sha256, again.made) == (motion.name, SHA, motion.made)
    assert type(again.path) is type(path)
    time = np.linspace(-1.0, path.duration + 1.0, 50)
    for one, other in zip(again.path.derivatives(time, 4), path.derivatives(time, 4), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.to_json() == motion.to_json()


def test_both_kinds_are_read_back_as_what_they_were() -> None:
    assert isinstance(excitation_from_json(json.dumps(content_of(1))).path, FourierPath)
    assert isinstance(excitation_from_json(json.dumps(content_of(2))).path, PosturePath)


def test_the_file_is_small_and_says_what_it_is() -> None:
    content = content_of(0)
    assert (content["format"], content["version"], content["kind"]) == ("ident-excitation", 1, "fourier")
    assert content["arm"] == {"sha256": SHA}


def places(value: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where anything stands in a JSON value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [way, *(place for key, item in inner for place in places(item, (*way, key)))]


def mutilated(content: Any, place: tuple[Any, ...], value: Any) -> Any:
    """The same with something else, or with nothing (`...`), at one place."""
    if not place:
        return None if value is ... else value
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    if value is ...:
        del inner[place[-1]]
    else:
        inner[place[-1]] = value
    return content


@pytest.mark.slow
@some(100)
@given(seed=st.integers(0, 2), data=st.data())
def test_a_mutilated_file_is_read_or_refused_with_a_reason(seed: int, data: st.DataObject) -> None:
    content = content_of(seed)
    for _ in range(data.draw(st.integers(1, 2))):
        if isinstance(content, dict | list):
            place = data.draw(st.sampled_from(places(content)))
            content = mutilated(content, place, data.draw(VALUES | st.just(...)))
    try:
        motion = excitation_from_json(json.dumps(content))
    except UsageError as error:
        assert str(error)  # noqa: PT017
        return
    assert motion.duration > 0.0
    with np.errstate(all="ignore"):  # of frequencies and sizes that are numbers, but nothing else
        assert motion.path.at(0.0)[0].shape == (motion.path.joints,)
    assert excitation_from_json(motion.to_json()).to_json() == motion.to_json()


@some(50)
@given(text=st.text(max_size=30))
@example(text="[" * 100_000)
@example(text='{"format": "ident-excitation", "version": 1}')
@example(text="1" * 5000)
def test_any_other_text_is_refused_with_a_reason(text: str) -> None:
    with pytest.raises(UsageError, match=r"JSON|version|missing"):
        excitation_from_json(text)


@settings(max_examples=100)
@given(seed=st.integers(0, 2), share=st.floats(0.0, 0.999))
def test_a_file_cut_off_is_refused(seed: int, share: float) -> None:
    text = Excitation("x", random_path(seed), SHA).to_json()
    with pytest.raises(UsageError, match="not JSON"):
        excitation_from_json(text[: int(share * len(text))])


FOURIER_MISTAKES = [
    (("format",), "ident-arm", "not a motion"),
    (("version",), 2, "version 2"),
    (("kind",), "spline", "'spline' is none of fourier, postures"),
    (("kind",), ..., "'kind' is missing"),
    (("kind",), [], "none of fourier, postures"),
    (("name",), ..., "'name' is missing"),
    (("name",), 3, "must be text"),
    (("arm",), ..., "'arm' is missing"),
    (("arm",), "ab", "'arm' must be an object"),
    (("arm", "sha256"), ..., "'sha256' is missing"),
    (("arm", "sha256"), 5, "must be text"),
    (("made",), [], "made an object"),
    (("base_frequency",), 0, "above zero"),
    (("base_frequency",), -0.1, "above zero"),
    (("base_frequency",), 1e-9, "base_frequency must be"),
    (("base_frequency",), 5e-324, "base_frequency must be"),
    (("base_frequency",), "0.1", "finite number"),
    (("base_frequency",), True, "finite number"),
    (("base_frequency",), float("inf"), "base_frequency must be a finite number"),
    (("base_frequency",), 10**400, "base_frequency must be a finite number"),
    (("periods",), 0, "no motion"),
    (("periods",), 1.5, "whole number"),
    (("periods",), True, "whole number"),
    (("periods",), 10**6, "the longest is"),
    (("periods",), 10**400, "no more than"),
    (("ramp",), -1, "no motion"),
    (("ramp",), None, "ramp must be a finite number"),
    (("ramp",), 1e6, "the longest is"),
    (("a",), [], "a must be"),
    (("a",), [1.0, 2.0], "a must be"),
    (("a",), [[1.0], [2.0]], "do not belong to one motion"),
    (("a", 0, 0), None, "finite numbers"),
    (("a", 0, 0), float("nan"), "finite numbers"),
    (("a", 0, 0), 10**400, "numbers"),
    (("a", 0, 0), [1.0], "rows of numbers"),
    (("a", 0, 0), "0.5", "numbers"),
    (("b", 0, 0), ..., "rows of numbers"),
    (("q0",), [0.0], "do not belong to one motion"),
    (("q0",), {}, "q0 must be numbers"),
]


@pytest.mark.parametrize(("place", "value", "message"), FOURIER_MISTAKES)
def test_every_mistake_in_a_fourier_motion_is_named(place: tuple[Any, ...], value: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        excitation_from_json(json.dumps(mutilated(content_of(1), place, value)))


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("points",), [[1.0, 2.0]], "do not belong to one motion"),
        (("points",), [], "points must be"),
        (("times",), [1.0], "do not belong to one motion"),
        (("times", 0), 0.0, "do not belong to one motion"),
        (("times", 0), -1.0, "do not belong to one motion"),
        (("times", 0), 1e6, "the longest is"),
        (("dwell",), -0.1, "no time"),
        (("dwell",), ..., "'dwell' is missing"),
    ],
)
def test_every_mistake_in_segments_between_postures_is_named(place: tuple[Any, ...], value: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        excitation_from_json(json.dumps(mutilated(content_of(2), place, value)))


def test_a_file_is_read_as_its_text(tmp_path: Path) -> None:
    motion = Excitation("x", random_path(2), SHA)
    (tmp_path / "x.json").write_text(motion.to_json(), encoding="utf-8")
    assert read_excitation(tmp_path / "x.json").to_json() == motion.to_json()


def test_a_refusal_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    with pytest.raises(UsageError, match=r"x\.json: cannot be read"):
        read_excitation(file)
    with pytest.raises(UsageError, match="cannot be read"):
        read_excitation(tmp_path)
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match=r"x\.json: not UTF-8"):
        read_excitation(file)
    file.write_text(json.dumps(mutilated(content_of(2), ("dwell",), -1)))
    with pytest.raises(UsageError, match=r"x\.json: .*no time"):
        read_excitation(file)
    file.write_text(" " * (4 * 2**20 + 1))
    with pytest.raises(UsageError, match=r"x\.json: larger than"):
        read_excitation(file)
