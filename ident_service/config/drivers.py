"""What an arm's driver section may be: a simulated arm, CANopen drives, or another distribution's driver."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, Tag

from ident_service.config.canopen import CanopenDriver
from ident_service.config.quantities import Count, ParameterTable, PerJoint, Positive, Section, Seed
from ident_service.config.simulation import SimulatedFault


class SimulatedDriver(Section):
    """The simulated arm: true parameters and imperfections, all per joint or one number for all.

    `process` says where its plant lives; `bus` names a separate one that other processes may ask for, `status` the file
    it reports to, `deadline` [s] how long an answer of it may take. `watchdog` [s] without a torque frame makes
    the drives idle; idle drives brake with `braking` [N m s/rad].
    """

    kind: Literal["simulated"]
    time: Literal["virtual", "real"] = "virtual"
    process: Literal["own", "separate"] = "own"
    bus: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")] | None = None
    status: str | None = None
    deadline: Positive | None = None
    seed: Seed = 0
    truth: ParameterTable | None = None
    encoder_resolution: PerJoint = 0.0
    torque_resolution: PerJoint = 0.0
    torque_noise: PerJoint = 0.0
    delay_cycles: Annotated[Count, Field(le=100)] = 1
    watchdog: Positive = 0.01
    braking: PerJoint | None = None
    faults: tuple[SimulatedFault, ...] = ()


class PluginDriver(Section):
    """A driver that another distribution provides; it checks its own options."""

    model_config = ConfigDict(frozen=True, extra="allow")

    kind: str


def _driver_kind(value: Any) -> str:
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return kind if kind in ("simulated", "canopen") else "plugin"


# A driver of ours with a mistake must not pass for somebody else's.
Driver = Annotated[
    Annotated[SimulatedDriver, Tag("simulated")]
    | Annotated[CanopenDriver, Tag("canopen")]
    | Annotated[PluginDriver, Tag("plugin")],
    Discriminator(_driver_kind),
]
