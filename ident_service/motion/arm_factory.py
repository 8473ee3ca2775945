"""Create the `Arm` of a configuration from drivers registered under an entry point, third-party ones too."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import cast

from drivers.arm import Arm
from drivers.clock import Clock
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError, UsageError

GROUP = "ident_service.drivers"


def make_arm(config: ArmConfig, clock: Clock | None = None) -> Arm:
    """Create the arm that a configuration describes, not yet open.

    Args:
        config: its `driver.kind` names an entry point of the group `ident_service.drivers`.
        clock: the loop's clock; by default the one the driver section asks for.

    Raises:
        UsageError: the description has no driver section.
        DriverError: nothing is registered under its kind.
    """
    if config.driver is None:
        raise UsageError(f"{config.name}: the arm has no driver section, so it cannot be moved")
    found = entry_points(group=GROUP, name=config.driver.kind)
    if not found:
        known = ", ".join(sorted(entry.name for entry in entry_points(group=GROUP)))
        raise DriverError(f"{config.name}: no driver is called {config.driver.kind!r}; installed: {known}")
    return cast(Arm, next(iter(found)).load()(config, clock))
