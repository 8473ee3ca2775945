"""Draw the figures of the documents into docs/images: `make docs-figures`.

Diagrams of states follow from the code, figures about concepts from what it computes. Each SVG says in its metadata
what it was drawn from, by which a test notices that the states are out of date.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch
from scipy.signal import lfilter

from ident_service.config.load import load_arm
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.motion.state_machine import STOPPABLE, TRANSITIONS, State

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#6e7781"  # Okabe and Ito, 2008
mpl.rcParams.update({"svg.hashsalt": "ident", "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 10})


def saved(figure: Figure, name: str, drawn_from: str) -> None:
    """Write a figure; the same figure is the same file."""
    metadata = {"Date": None, "Description": drawn_from}
    figure.savefig(IMAGES / f"{name}.svg", metadata=metadata, facecolor="white", bbox_inches="tight")


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """Create an empty drawing; its unit is about a centimetre."""
    figure = Figure(figsize=(width / 2.0, height / 2.0))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(0.0, height), aspect="equal")
    axes.axis("off")
    return figure, axes


def box(
    axes: Axes, x: float, y: float, text: str, colour: str = BLUE, *, width: float = 2.6, height: float = 1.0
) -> None:
    """Draw a box with a text in its middle."""
    corner = (x - width / 2.0, y - height / 2.0)
    shape = FancyBboxPatch(
        corner, width, height, boxstyle="round,pad=0,rounding_size=0.15", fc="white", ec=colour, lw=1.5
    )
    axes.add_patch(shape)
    axes.text(x, y, text, ha="center", va="center")


def arrow(
    axes: Axes, start: Sequence[float], end: Sequence[float], text: str = "", *, bend: float = 0.0, colour: str = GREY
) -> None:
    """Draw an arrow, with a text beside its middle."""
    style = f"arc3,rad={bend}"
    axes.add_patch(
        FancyArrowPatch(
            tuple(start), tuple(end), arrowstyle="-|>", mutation_scale=12, connectionstyle=style, color=colour
        )
    )
    if text:
        middle = (np.asarray(start) + np.asarray(end)) / 2.0
        axes.text(middle[0], middle[1] + 0.25, text, ha="center", va="center", fontsize=8, color="#1f2328")


def workflow() -> None:
    """Draw the way from a description to an accepted model, and back again for drift."""
    steps = ("describe", "check", "design", "preflight", "run", "identify", "accept")
    made = ("robot.yaml", "", "motion.json", "ticket", "run.mcap", "parameters.json", "accepted set")
    figure, axes = canvas(24.0, 4.2)
    for number, (step, file) in enumerate(zip(steps, made, strict=True)):
        x = 1.6 + 3.45 * number
        box(axes, x, 2.8, step, ORANGE if step in ("preflight", "run") else BLUE)
        axes.text(x, 1.9, file, ha="center", fontsize=8, color=GREY)
        if number:
            arrow(axes, (x - 2.15, 2.8), (x - 1.3, 2.8))
    arrow(axes, (22.3, 2.25), (12.0, 2.25), bend=-0.22, colour=GREEN)
    axes.text(17.2, 0.5, "re-identify: has the arm changed?", ha="center", fontsize=9, color=GREEN)
    axes.text(13.7, 3.75, "the arm moves", ha="center", fontsize=9, color=ORANGE)
    saved(figure, "workflow", "the table of docs/index.md")


PLACES: dict[State, tuple[float, float]] = {
    State.IDLE: (1.6, 6.5),
    State.CHECKED: (5.1, 6.5),
    State.ARMED: (8.6, 6.5),
    State.APPROACHING: (12.1, 6.5),
    State.EXCITING: (15.6, 6.5),
    State.RETURNING: (19.1, 6.5),
    State.DONE: (23.2, 6.5),
    State.PAUSING: (12.1, 3.6),
    State.PAUSED: (15.6, 3.6),
    State.RESUMING: (19.1, 3.6),
    State.STOPPING: (12.1, 0.8),
    State.STOPPED: (23.2, 0.8),
    State.FAULTED: (1.6, 0.8),
}


def transitions() -> str:
    """Return the transitions of the state machine as text, as the figure's metadata has them."""
    return "; ".join(f"{one.value}: {' '.join(to.value for to in many)}" for one, many in TRANSITIONS.items())


def states() -> None:
    """Draw the states of a motion; what leads to stopping and faulted is drawn once for all.

    Raises:
        ValueError: the transitions to these two are not as the drawing says.
    """
    stopping = {one for one, many in TRANSITIONS.items() if State.STOPPING in many}
    faulting = {one for one, many in TRANSITIONS.items() if State.FAULTED in many}
    if stopping != set(STOPPABLE) or faulting != set(State) - {State.FAULTED}:
        raise ValueError("draw the transitions to stopping and faulted one by one")
    figure, axes = canvas(25.0, 8.2)
    axes.set_ylim(-0.6, 8.2)
    frame = FancyBboxPatch(
        (7.0, 2.7), 13.9, 5.0, boxstyle="round,pad=0,rounding_size=0.3", fc="#f6f8fa", ec=GREY, ls="--"
    )
    axes.add_patch(frame)
    for one, (x, y) in PLACES.items():
        calm = {State.STOPPING: ORANGE, State.STOPPED: ORANGE, State.FAULTED: "#b00020"}
        box(axes, x, y, one.value, calm.get(one, BLUE))
    for one, many in TRANSITIONS.items():
        for to in many:
            if to is State.IDLE and one in (State.DONE, State.STOPPED):  # a long way back: only begun
                x, y = PLACES[one]
                arrow(axes, (x, y + 0.5 * np.sign(y - 3.0)), (x, y + 1.1 * np.sign(y - 3.0)))
                axes.text(x + 0.2, y + 0.9 * np.sign(y - 3.0), "to idle", fontsize=8, va="center")
            elif to not in (State.STOPPING, State.FAULTED):
                _edge(axes, PLACES[one], PLACES[to])
    arrow(axes, (12.1, 2.7), (12.1, 1.35), colour=ORANGE)
    axes.text(12.4, 2.05, "stop request, lost lease, fault with controlled stop", fontsize=8, va="center")
    axes.text(3.1, 0.8, "from every other state,\nby a more severe fault", fontsize=8, va="center")
    saved(figure, "states", transitions())


def _edge(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw an arrow between two boxes, around those that stand between them."""
    (x, y), (u, v) = start, end
    if y == v:
        if abs(u - x) < 5.5 or y < 2.0:
            side = 1.3 if u > x else -1.3
            shift = 0.2 if u > x else -0.2
            arrow(axes, (x + side, y + shift), (u - side, v + shift))
        else:
            up = 0.5 if y > 5.0 or u < x else -0.5
            arrow(axes, (x, y + up), (u, v + up), bend=-0.12 if u > x else 0.18)
    else:
        down = -0.5 if y > v else 0.5
        arrow(axes, (x + 0.3 * np.sign(down), y + down), (u + 0.3 * np.sign(down), v - down))


def processes() -> None:
    """Draw the processes of a motion and what they exchange."""
    figure, axes = canvas(24.0, 9.4)
    for x, y, text, colour in (
        (1.8, 7.6, "person", GREEN),
        (1.8, 4.6, "program", GREEN),
        (7.2, 4.6, "ident serve", BLUE),
        (7.2, 7.6, "ident ...", BLUE),
        (13.4, 7.6, "motion process", ORANGE),
        (13.4, 4.6, "recorder process", BLUE),
        (13.4, 1.2, "target process", BLUE),
        (21.6, 7.6, "drives", GREY),
        (21.6, 4.6, "MCAP file", GREY),
        (21.6, 1.2, "ident identify", BLUE),
    ):
        box(axes, x, y, text, colour, width=3.4)
    arrow(axes, (3.5, 7.6), (5.5, 7.6))
    arrow(axes, (3.5, 4.6), (5.5, 4.6), "HTTP")
    arrow(axes, (7.2, 5.1), (7.2, 7.1))
    axes.text(7.35, 6.1, "a command\nper job", fontsize=8, va="center")
    arrow(axes, (8.9, 7.6), (11.7, 7.6), "lease, stop")
    arrow(axes, (8.9, 7.3), (11.7, 4.9), "starts")
    arrow(axes, (15.1, 7.6), (19.9, 7.6), "cyclic frames")
    arrow(axes, (13.4, 7.1), (13.4, 5.1))
    axes.text(13.55, 6.1, "ring in shared memory", fontsize=8, va="center")
    arrow(axes, (15.1, 4.6), (19.9, 4.6), "records")
    arrow(axes, (20.6, 4.1), (15.1, 1.4), "run --until")
    arrow(axes, (21.6, 4.1), (21.6, 1.7))
    saved(figure, "processes", "the table of docs/architecture.md")


def base_parameter_table() -> None:
    """Draw which link parameters of the planar arm go into which base parameter."""
    model = arm_model(load_arm("planar2"))
    base = base_parameters(model.chain, model.layout)
    figure = Figure(figsize=(9.0, 4.2))
    axes = figure.add_subplot()
    size = float(np.abs(base.K).max())
    axes.imshow(base.K, cmap="PuOr", vmin=-size, vmax=size, aspect="equal")
    axes.set_xticks(range(len(base.names)), base.names, rotation=90, fontsize=8)
    axes.set_yticks(range(base.size), [base.names[k] for k in base.base], fontsize=8)
    for row, column in np.argwhere(np.abs(base.K) > 1e-9):
        axes.text(column, row, f"{base.K[row, column]:.3g}", ha="center", va="center", fontsize=6)
    axes.set(xlabel="link parameters: 28", ylabel=f"base parameters: {base.size}")
    empty = np.flatnonzero(np.abs(base.K).max(axis=0) < 1e-9)
    axes.set_title(f"{len(empty)} link parameters (empty columns) change no torque at all", fontsize=10)
    saved(figure, "base-parameters", "K of planar2 (eq. 38)")


def feasible_sets() -> None:
    """Draw two sections of the feasible set: of a mass and its moments, and of the principal moments of inertia."""
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    lever = np.linspace(-0.6, 0.6, 200)
    left.fill_between(lever, lever**2, 0.4, color=BLUE, alpha=0.15)
    left.plot(lever, lever**2, color=BLUE)
    estimate = np.array([0.42, 0.10])
    # The nearest point of the parabola in the metric of the covariance.
    deviation = np.array([0.05, 0.03])
    distance = ((np.stack([lever, lever**2]).T - estimate) / deviation) ** 2
    nearest = lever[int(np.argmin(distance.sum(axis=1)))]
    for factor in (1.0, 2.0):
        width, height = 2.0 * factor * deviation
        left.add_patch(Ellipse((estimate[0], estimate[1]), width, height, fill=False, ec=ORANGE, lw=0.8))
    left.plot(*estimate, "o", color=ORANGE, label="least squares: no body has it")
    left.plot(nearest, nearest**2, "s", color=GREEN, label="nearest feasible")
    left.set(
        xlabel="first moment $l_x$ [kg m]", ylabel="inertia $L_{zz}$ [kg m$^2$]", ylim=(0.0, 0.4), xlim=(-0.6, 0.6)
    )
    left.set_title("a body of 1 kg: $L_{zz} \\geq l_x^2/m$", fontsize=10)
    left.legend(loc="upper center", fontsize=8)
    grid = np.linspace(0.0, 2.5, 300)
    first, second = np.meshgrid(grid, grid)
    triangle = (first + second >= 1.0) & (first + 1.0 >= second) & (second + 1.0 >= first)
    right.contourf(first, second, triangle.astype(float), levels=[0.5, 1.5], colors=[BLUE], alpha=0.3)
    right.axhline(0.0, color=GREY)
    right.axvline(0.0, color=GREY)
    right.text(1.2, 1.2, "pseudo_inertia:\na real body", ha="center", fontsize=9)
    right.text(0.35, 2.1, "inertia only", ha="center", fontsize=9)
    right.text(2.1, 0.3, "inertia only", ha="center", fontsize=9)
    right.set(xlabel="$I_{xx}$ [kg m$^2$]", ylabel="$I_{yy}$ [kg m$^2$]", xlim=(0.0, 2.5), ylim=(0.0, 2.5))
    right.set_title("principal moments with $I_{zz} = 1$", fontsize=10)
    saved(figure, "feasibility", "eq. 17 and the pseudo-inertia")


def deviations() -> None:
    """Draw how wrong standard deviations of independent samples are for residuals that are correlated in time."""
    rng = np.random.default_rng(1)
    samples, block, trials = 6000, 100, 400
    time = np.arange(samples) * 0.01
    regressor = np.stack([np.sin(0.7 * time), np.sign(np.cos(0.7 * time)), np.ones(samples)], axis=1)
    inverse = np.linalg.inv(regressor.T @ regressor)
    scores: list[tuple[float, float]] = []
    for _ in range(trials):
        noise = lfilter([1.0], [1.0, -0.95], rng.standard_normal(samples))
        found = inverse @ regressor.T @ noise  # the true parameters are zero
        residual = noise - regressor @ found
        naive = np.sqrt(inverse[0, 0] * (residual @ residual) / (samples - 3))
        parts = (regressor * residual[:, None]).reshape(-1, block, 3).sum(axis=1)
        blocks = np.sqrt((inverse @ (parts.T @ parts) @ inverse)[0, 0])
        scores.append((found[0] / naive, found[0] / blocks))
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    names = ("samples taken as independent", "blocks of a second")
    for axes, score, name, colour in zip(
        figure.subplots(1, 2, sharey=True), np.array(scores).T, names, (ORANGE, BLUE), strict=True
    ):
        edges = np.linspace(-16.0, 16.0, 65)
        axes.hist(score, bins=edges, density=True, color=colour, alpha=0.5)
        axes.plot(edges, np.exp(-(edges**2) / 2.0) / np.sqrt(2.0 * np.pi), color="black", lw=1.0)
        outside = np.mean(np.abs(score) > 2.0)
        axes.set_title(f"{name}: {outside:.0%} beyond two deviations", fontsize=10)
        axes.set(xlabel="error / standard deviation", xlim=(-16.0, 16.0))
    saved(figure, "uncertainty", "400 identifications with noise of a correlation of 0.95 between samples")


UNKNOWN = 1.0  # where a deviation that is infinite is drawn
MOTIONS = {
    "one harmonic of 0.2 rad": "{kind: fourier, base_frequency: 0.1, periods: 2, ramp: 1, joints: "
    "{shoulder: {a: [0.1], b: [0.05], q0: 0}, elbow: {a: [0.05], b: [0.1], q0: 0}}}",
    "five harmonics, random": "{kind: seeded, seed: 1, base_frequency: 0.1, harmonics: 5, periods: 2}",
}


def excitation() -> None:
    """Draw the deviations to be expected after three motions of the planar arm, all of twenty seconds."""
    with tempfile.TemporaryDirectory() as folder:
        answers = {}
        for number, (name, motion) in enumerate(MOTIONS.items()):
            path = Path(folder, f"motion{number}.yaml")
            path.write_text(f"extends: planar2\nname: planar2\nmotions: {{identification: {motion}}}\n")
            answers[name] = _ident(folder, "preview", str(path))
        options = ("--length", "20", "--base-frequency", "0.1", "--ramp", "0", "--starts", "2", "--out", "motion")
        _ident(folder, "design", "planar2", *options)
        answers["designed, two starts"] = _ident(folder, "preview", "planar2", "motion/motion.json")
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for (name, answer), marker, colour in zip(answers.items(), "v^o", (ORANGE, GREY, BLUE), strict=True):
        expected = answer["base_parameters"]["expected_standard_deviations"]
        condition = answer["condition_number"] or np.inf
        # What no row determines has no deviation; it stands on the line at the top.
        expected = [UNKNOWN if value is None else value for value in expected]
        label = f"{name}: condition number {condition:.0f}"
        axes.semilogy(range(len(expected)), expected, marker, color=colour, label=label)
    names = next(iter(answers.values()))["base_parameters"]["expressions"]
    axes.set_xticks(range(len(names)), [name.split(" ")[0] for name in names])
    axes.axhline(UNKNOWN, color=GREY, lw=0.8, ls="--")
    axes.text(len(names) - 0.5, 1.3 * UNKNOWN, "not determined at all", ha="right", fontsize=8)
    axes.set_ylim(top=10.0 * UNKNOWN)
    axes.set_ylabel("expected standard deviation\n[SI unit of the parameter]")
    axes.grid(axis="y", alpha=0.3)
    # Above the axes: within, it would cover markers.
    figure.legend(fontsize=8, loc="outside upper center", ncols=3)
    saved(figure, "excitation", "ident preview of three motions of planar2")


def _ident(folder: str, *words: str) -> dict[str, object]:
    command = [sys.executable, "-m", "ident_service", *words, "--json", "--state", f"{folder}/state"]
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)  # noqa: S603 - our own command
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def main() -> None:
    """Draw all of them."""
    IMAGES.mkdir(exist_ok=True)
    for draw in (workflow, states, processes, base_parameter_table, feasible_sets, deviations, excitation):
        draw()


if __name__ == "__main__":
    main()
