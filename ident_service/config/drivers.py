"""Describe an arm's driver section: a simulated arm, CANopen drives, or another distribution's driver."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Discriminator, Tag

from ident_service.config.canopen import CanopenDriver
from ident_service.config.quantities import Section
from ident_service.config.simulation import SimulatedDriver


class PluginDriver(Section):
    """Driver that another distribution provides; it checks its own options."""

    model_config = ConfigDict(frozen=True, extra="allow")

    kind: str


def _driver_kind(value: Any) -> str:
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return kind if kind in ("simulated", "canopen") else "plugin"


# Chosen by `kind`, so that a mistake in a built-in driver's section is not taken for a plug-in's options.
Driver = Annotated[
    Annotated[SimulatedDriver, Tag("simulated")]
    | Annotated[CanopenDriver, Tag("canopen")]
    | Annotated[PluginDriver, Tag("plugin")],
    Discriminator(_driver_kind),
]
