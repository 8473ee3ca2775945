"""Style the kinds of shape in drawings, light and dark, by one sheet that travels inside every drawing.

Colours follow Okabe and Ito, "Color Universal Design" (2008), so that no meaning hangs on telling red from green.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

STEPS = 8  # shades from early to late

# Light colours, for every program without a dark mode.
_LIGHT = {
    "ground": "fill:#ffffff",
    "ink": "fill:#1f2328",
    "soft": "fill:#57606a",
    "warn": "fill:#b04a00",
    "frame": "stroke:#b6bec8",
    "grid": "stroke:#e3e7ec",
    "limit": "stroke:#d55e00",
    "trace": "stroke:#0072b2",
    "path": "stroke:#009e73",
    "closest": "stroke:#d55e00",
    "dot": "fill:#d55e00;stroke:#ffffff",
    "base": "fill:#1f2328",
    "rule": "stroke:#1f2328",
    "ramp": "fill:#8c959f",
    "solid": "fill:#8c959f",
    "edge": "stroke:#6e7781",
    "rod": "stroke:#8c959f",
    "halo": "stroke:#ffffff",
    "measured": "fill:#0072b2;stroke:#0072b2",
    "predicted": "fill:#d55e00;stroke:#d55e00",
    "residual": "fill:#007a5a;stroke:#007a5a",
    "first": "stroke:#0072b2",
    "second": "stroke:#d55e00",
    "cloud": "fill:#0072b2",
    "good": "fill:#0072b2",
    "doubt": "fill:#e69f00",
    "bad": "fill:#d55e00",
    "plus": "fill:#0072b2",
    "minus": "fill:#d55e00",
    "body": "fill:#56b4e9;stroke:#0072b2",
}
_DARK = {
    "ground": "fill:#0d1117",
    "ink": "fill:#e6edf3",
    "soft": "fill:#9da7b3",
    "warn": "fill:#ffa657",
    "frame": "stroke:#4a535e",
    "grid": "stroke:#222931",
    "limit": "stroke:#e69f00",
    "trace": "stroke:#56b4e9",
    "path": "stroke:#2fc79b",
    "closest": "stroke:#ff9440",
    "dot": "fill:#ff9440;stroke:#0d1117",
    "base": "fill:#e6edf3",
    "rule": "stroke:#e6edf3",
    "ramp": "fill:#8c959f",
    "solid": "fill:#8c959f",
    "edge": "stroke:#9da7b3",
    "rod": "stroke:#8c959f",
    "halo": "stroke:#0d1117",
    "measured": "fill:#56b4e9;stroke:#56b4e9",
    "predicted": "fill:#ff9440;stroke:#ff9440",
    "residual": "fill:#2fc79b;stroke:#2fc79b",
    "first": "stroke:#56b4e9",
    "second": "stroke:#ff9440",
    "cloud": "fill:#56b4e9",
    "good": "fill:#56b4e9",
    "doubt": "fill:#f0e442",
    "bad": "fill:#ff9440",
    "plus": "fill:#56b4e9",
    "minus": "fill:#ff9440",
    "body": "fill:#56b4e9;stroke:#9acdf2",
}
# From hardly visible on the ground to clearly visible, in either mode.
_LIGHT_STEPS = ("#c6d9ea", "#b0cce4", "#95bbdb", "#76a9d0", "#538fbf", "#3475aa", "#1b5c91", "#0a4475")
_DARK_STEPS = ("#22394d", "#27445e", "#2c5171", "#315e83", "#3d75a1", "#4f8fbf", "#6dacd9", "#9acdf2")
_SHAPES = {
    "": "font-family:sans-serif",
    "grid": "stroke-width:1",
    "frame": "stroke-width:1;fill:none",
    "limit": "stroke-width:1.2;stroke-dasharray:5 3",
    "trace": "stroke-width:1.2;fill:none;stroke-linejoin:round",
    "path": "stroke-width:1.1;fill:none;stroke-linejoin:round",
    "posture": "stroke-width:2;fill:none;stroke-linejoin:round;stroke-linecap:round",
    "closest": "stroke-width:3.2;fill:none;stroke-linejoin:round;stroke-linecap:round",
    "gap": "stroke-width:1.4;stroke-dasharray:2 2",
    "dot": "stroke-width:1",
    "ramp": "fill-opacity:.16",
    "solid": "fill-opacity:.28",
    "edge": "stroke-width:1.4;fill:none",
    "room": "stroke-width:1.2;fill:none;stroke-dasharray:8 3 2 3",
    "rod": "stroke-linecap:round;stroke-opacity:.45",
    "halo": "paint-order:stroke;stroke-width:3;stroke-linejoin:round",
    "rule": "stroke-width:1.6;fill:none",
    "strong": "font-weight:bold",
    "measured": "stroke-width:3;stroke-linejoin:round;fill-opacity:.6;stroke-opacity:.6",
    "predicted": "stroke-width:.8;stroke-linejoin:round;fill-opacity:.8",
    "residual": "stroke-width:1;stroke-linejoin:round",
    "first": "stroke-width:1.4;fill:none;stroke-linejoin:round",
    "second": "stroke-width:1.4;fill:none;stroke-linejoin:round;stroke-dasharray:6 2",
    "cloud": "fill-opacity:.45",
    "body": "fill-opacity:.3;stroke-width:1.2",
}


def style() -> str:
    """Return the style sheet as an SVG element; readers who prefer dark get the dark colours."""
    return f"<style>{sheet()}</style>"


def sheet() -> str:
    """Return the style sheet as CSS, for a page that holds many drawings."""

    def rules(rows: Iterable[tuple[str, str]]) -> str:
        # Everything below one class: a style inside an SVG would otherwise reach the page around it.
        return "".join(f".ident-figure{f' .{name}' if name else ''}{{{body}}}" for name, body in rows)

    def steps(shades: Sequence[str]) -> list[tuple[str, str]]:
        return [(f"step{number}", f"stroke:{shade}") for number, shade in enumerate(shades)]

    light = rules([*_SHAPES.items(), *_LIGHT.items(), *steps(_LIGHT_STEPS)])
    dark = rules([*_DARK.items(), *steps(_DARK_STEPS)])
    return f"{light}@media (prefers-color-scheme:dark){{{dark}}}"
