"""The pencil: thinning keeps every pixel column's extremes, any text is XML, numbers are for people."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from results.svg import Svg

from ident_service.errors import UsageError
from ident_service.results.plots import (
    STEPS,
    Axes,
    Canvas,
    format_number,
    require_drawable,
    round_values,
    svg_style,
    visible_samples,
    xml_text,
)


@given(
    steps=st.lists(st.floats(1e-3, 10.0), min_size=1, max_size=400),
    seed=st.integers(0, 2**32 - 1),
    columns=st.integers(1, 60),
    levels=st.integers(1, 50),
)
def test_thinning_keeps_every_column_s_extremes(steps: list[float], seed: int, columns: int, levels: int) -> None:
    time = np.cumsum([0.0, *steps])
    # Few levels make many ties.
    values = np.random.default_rng(seed).integers(0, levels, len(time)).astype(float)
    kept = visible_samples(time, values, columns)
    assert (np.diff(kept) > 0).all()
    assert kept[0] == 0
    assert kept[-1] == len(time) - 1
    assert len(kept) <= max(2 * columns + 2, len(time) if len(time) <= 2 * columns else 0)
    place = np.minimum((time - time[0]) / (time[-1] - time[0]) * columns, columns - 1).astype(int)
    for column in np.unique(place):
        here, there = values[place == column], values[kept][place[kept] == column]
        assert (here.min(), here.max()) == (there.min(), there.max())


def test_thinning_leaves_few_samples_alone() -> None:
    np.testing.assert_array_equal(visible_samples(np.arange(20.0), np.zeros(20), 10), np.arange(20))


def test_one_sample_among_many_is_seen() -> None:
    time, values = np.linspace(0.0, 60.0, 60_001), np.zeros(60_001)
    values[12_345] = 1.0
    kept = visible_samples(time, values, 232)
    assert 12_345 in kept
    assert len(kept) <= 2 * 232 + 2


@given(st.text())
def test_any_text_is_xml(text: str) -> None:
    canvas = Canvas(100.0, 50.0)
    canvas.text("ink", 1.0, 2.0, "." + text, hint=text)
    svg = Svg.of(canvas.svg(text, text))
    expected = re.sub("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", text)
    # XML reads every line break as one kind.
    assert svg.title == expected.replace("\r\n", "\n").replace("\r", "\n")


def test_markup_in_names_is_only_text() -> None:
    assert xml_text("<script a='1'>&\x00\ud800") == "&lt;script a=&#x27;1&#x27;&gt;&amp;\ufffd\ufffd"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (-0.0, "0"),
        (-2.6179938, "−2.62"),
        (1250.0, "1250"),
        (12345.6, "12346"),
        (0.05, "0.05"),
        (1e9, "1e+09"),
    ],
)
def test_numbers_for_people(value: float, text: str) -> None:
    assert format_number(value) == text


@given(low=st.floats(-1e6, 1e6), span=st.floats(1e-3, 1e6), most=st.integers(1, 12))
def test_round_values_are_few_even_and_inside(low: float, span: float, most: int) -> None:
    values = round_values(low, low + span, most)
    assert len(values) <= most + 1
    assert all(low - 1e-6 * span <= value <= low + span + 1e-6 * span for value in values)
    if len(values) > 2:
        np.testing.assert_allclose(np.diff(values), values[1] - values[0], rtol=1e-4)


def test_axes_map_corners_to_corners() -> None:
    axes = Axes(10.0, 20.0, 100.0, 50.0, -1.0, 1.0, 0.0, 5.0)
    assert (float(axes.x(-1.0)), float(axes.x(1.0))) == (10.0, 110.0)
    assert (float(axes.y(0.0)), float(axes.y(5.0))) == (70.0, 20.0)


@pytest.mark.parametrize(
    ("values", "shape", "unlimited", "message"),
    [
        (np.zeros((2, 3)), (3, 2), False, r"cannot draw x: its shape is \(2, 3\), not \(3, 2\)"),
        (np.zeros((0, 3)), (0, 3), False, "cannot draw x: it is empty"),
        (np.array([0.0, np.nan]), (2,), False, r"cannot draw x: the value at \[1\] is nan"),
        (np.array([0.0, np.nan]), (2,), True, r"cannot draw x: the value at \[1\] is nan"),
        (np.array([[np.inf]]), (1, 1), False, r"cannot draw x: the value at \[0, 0\] is inf"),
        (np.array([-1e13]), (1,), False, r"the value at \[0\] is -10000000000000"),
    ],
)
def test_what_cannot_be_drawn(values: np.ndarray, shape: tuple[int, ...], unlimited: bool, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        require_drawable("x", values, shape, unlimited=unlimited)


def test_infinite_limits_can_be_drawn() -> None:
    require_drawable("x", np.array([np.inf, -np.inf, 1.0]), (3,), unlimited=True)


def test_every_colour_has_its_dark_one() -> None:
    light, dark = svg_style().split("@media (prefers-color-scheme:dark)")
    coloured = set(re.findall(r"\.ident-figure \.(\w+)\{(?:fill|stroke):#", light))
    assert coloured == set(re.findall(r"\.ident-figure \.(\w+)\{", dark))
    assert {f"step{number}" for number in range(STEPS)} <= coloured


def _luminance(colour: str) -> float:
    """Relative luminance of an sRGB colour (WCAG 2)."""
    channels = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize("dark", [False, True])
def test_contrast_is_enough_to_read(dark: bool) -> None:
    sheet = svg_style().split("@media (prefers-color-scheme:dark)")[dark]
    colours = dict(re.findall(r"\.ident-figure \.(\w+)\{(?:fill|stroke):(#\w{6})", sheet))

    def contrast(kind: str) -> float:
        one, other = sorted((_luminance(colours[kind]), _luminance(colours["ground"])))
        return (other + 0.05) / (one + 0.05)

    # WCAG 2.1: 1.4.3 for text, 1.4.11 for what has to be recognised.
    assert min(contrast(kind) for kind in ("ink", "soft", "warn")) >= 4.5
    assert min(contrast(kind) for kind in ("trace", "limit", "path", "closest", "edge", "base", "step7")) >= 3.0
    assert np.all(np.diff([contrast(f"step{number}") for number in range(STEPS)]) > 0.0)
