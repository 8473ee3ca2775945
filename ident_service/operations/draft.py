"""Draft an arm's description, and write it as the YAML file that a person completes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import yaml

RATE = 500.0  # Hz, at which most arms' gains are stable and a simulation is quick
CLEARANCE = 0.02  # m
FRICTION_GUESS = 0.04  # of the torque limits, what the description expects
ENCODER = 2e-5  # rad or m, of the simulated arm
_SECONDS = 20.0  # of a motion
LARGEST_USE = 0.6  # share of the limits of the first motion that is tried


@dataclass
class Draft:
    """Decided content of a description, to be written as YAML.

    Attributes:
        name: of the arm.
        urdf: name of the file beside the description.
        part: the keys of its kinematics.
        joints: keys of each joint.
        geometry: capsules of links whose meshes are replaced.
        may_touch: pairs that always touch.
        prior: names and values where the URDF's bodies are not those of real links; empty where they are.
        use: share of the limits that the motions take.
        seeds: of the two motions.
        frequency: of the two motions [Hz].
        cutoff: of the velocity's low-pass [Hz].
        standstill: speed below which a joint counts as standing [rad/s or m/s]; 0 for what is usual.
        total_mass: largest of the arm [kg].
        truth: of the simulated arm.
        remarks: what was guessed, for people.
    """

    name: str
    urdf: str
    part: dict[str, Any]
    joints: dict[str, dict[str, Any]] = field(default_factory=dict)
    geometry: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    may_touch: list[tuple[str, str]] = field(default_factory=list)
    prior: dict[str, float] = field(default_factory=dict)
    use: float = LARGEST_USE
    seeds: tuple[int, int] = (1, 2)
    frequency: float = 0.1
    cutoff: float = 30.0
    standstill: float = 0.0
    total_mass: float = 0.0
    truth: dict[str, float] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def short(value: float, digits: int = 4) -> float:
    """Round a number to some significant digits."""
    return float(f"{value:.{digits}g}")


def in_yaml(draft: Draft) -> str:
    """Return the description as YAML with comments."""
    guessed = "\n".join(f"#   {line}" for line in draft.remarks)
    head = f"""\
# {draft.name}, begun by `ident new` from {draft.urdf}. Look through it before a real arm moves by it.
# Guessed or chosen:
{guessed}
format: ident-arm
version: 1
name: {_flow(draft.name)}

kinematics: {_flow(draft.part)}

gravity: [0, 0, -9.81] # m/s^2 in the base frame: the arm stands upright
terms: [drive_inertia, viscous, coulomb, offset]
"""
    units = (
        "# rad, rad/s, rad/s^2, rad/s^3, N m; for slides m, m/s, m/s^2, m/s^3, N\n"
        "# Accelerations, jerks, following errors, gains, home and the drives' inertias are guesses."
    )
    parts = [head]
    if draft.joints:
        rows = "".join(f"  {_flow(name)}:\n    {_flow(keys)}\n" for name, keys in draft.joints.items())
        parts.append(f"{units}\njoints:\n{rows}")
    if draft.prior:
        parts.append(
            f"prior: # SI units, in the link frames; whose are guessed is said above\n  {_flow(draft.prior)}\n"
        )
    if draft.total_mass:
        parts.append(f"constraints: {{total_mass: {{upper: {draft.total_mass:g}}}}} # kg, twice what its links have\n")
    cutoff = "" if draft.cutoff == 30.0 else f", velocity_cutoff: {draft.cutoff:g}"
    parts.append(f"control: {{rate: {RATE:g}{cutoff}}} # Hz\n")
    if draft.geometry:
        rows = "".join(f"  {_flow(name)}: {_flow(each)}\n" for name, each in draft.geometry.items())
        parts.append(f"geometry: # m, in the link frames; around the URDF's meshes\n{rows}")
    space: dict[str, Any] = {"clearance": CLEARANCE}
    if draft.may_touch:
        space["may_touch"] = [list(pair) for pair in draft.may_touch]
    parts.append(
        f"workspace: {_flow(space)} # m\n"
        "# What else must not be touched, in the braces above, with motions that are clear of it (`ident design`):\n"
        "#   obstacles: {table: {half_space: {normal: [0, 0, 1], offset: -0.1}}}\n"
    )
    parts.append(
        f"design: {{friction_guess: [{FRICTION_GUESS:g}, {FRICTION_GUESS:g}]}} # shares of the torque limits\n"
    )
    if draft.standstill:
        parts.append(f"identification: {{reversal: {{speed: {draft.standstill:g}}}}} # rad/s or m/s\n")
    periods = round(_SECONDS * draft.frequency)
    motion = {
        "kind": "seeded", "about": "home", "base_frequency": draft.frequency, "harmonics": 5, "periods": periods,
        "use": draft.use,
    }  # fmt: skip
    first, second = ({**motion, "seed": seed} for seed in draft.seeds)
    parts.append(f"motions:\n  identification: {_flow(first)}\n  validation: {_flow(second)}\n")
    torque = [keys["torque"] for keys in draft.joints.values()]
    noise, step = ([short(share * value, 2) for value in torque] for share in (2e-3, 2e-4))
    driver: dict[str, Any] = {
        "kind": "simulated", "time": "virtual", "seed": 1, "truth": draft.truth, "encoder_resolution": ENCODER,
        "torque_resolution": step, "torque_noise": noise, "delay_cycles": 1,
    }  # fmt: skip
    rows = "".join(f"  {key}: {_flow(value)}\n" for key, value in driver.items() if value or key == "seed")
    parts.append(f"driver: # a simulated arm whose links, drives and friction are drawn about the prior's\n{rows}")
    return "\n".join(parts)


def _flow(value: Any) -> str:
    """Return a value in YAML's flow style on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6).strip()
    return text.removesuffix("\n...").removesuffix("...").strip()
