"""Represent one figure of a report: a drawing, and the sentence that says what good and bad look like."""

from __future__ import annotations

from dataclasses import dataclass

from ident_service.results.drawing import Canvas

WIDTH = 560.0  # px; two beside each other on a wide screen, one on a narrow one
LEFT, RIGHT = 62.0, 12.0


@dataclass(frozen=True)
class Zoom:
    """Data that the page's script needs to redraw a time plot over a shorter time.

    Attributes:
        recording: number of the recording.
        joint: number of the joint.
        time: lowest and highest time shown [s].
        torque: lowest and highest torque shown [N m or N].
        residual: lowest and highest residual shown [N m or N].
    """

    recording: int
    joint: int
    time: tuple[float, float]
    torque: tuple[float, float]
    residual: tuple[float, float]


@dataclass(frozen=True)
class Figure:
    """Drawing with its title, description and caption.

    Attributes:
        slug: name of its file, without an ending.
        title: what a screen reader says first.
        description: content of the drawing, for readers who cannot see it.
        caption: what it says, what good looks like and what bad.
        canvas: the drawing.
        zoom: for time plots.
        wide: whether it needs the whole width of a page.
    """

    slug: str
    title: str
    description: str
    caption: str
    canvas: Canvas
    zoom: Zoom | None = None
    wide: bool = False

    def svg(self, *, inline: bool = False) -> str:
        """Return the drawing as a file of its own, or for a page that has the style sheet."""
        return self.canvas.svg(self.title, self.description, inline=inline)
