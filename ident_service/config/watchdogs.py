"""Describe how a CANopen drive stops by itself when its host is gone."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from ident_service.config.quantities import GrownSection, Section

NodeId = Annotated[int, Field(strict=True, ge=1, le=127)]
Seconds = Annotated[float, Field(strict=True, ge=0.001, le=60.0)]  # whole ms of 16 bits in the drive
WatchdogKind = Literal["rpdo_timer", "heartbeat", "sync_loss", "node_guarding", "vendor"]
# Watchdogs whose reaction 6007h selects; a maker's own watchdog may have a reaction of its own.
ABORTING: Final = ("rpdo_timer", "heartbeat", "sync_loss", "node_guarding")
_MAKERS = range(0x2000, 0x6000)  # indices that CiA 301 leaves to makers of drives


class WatchdogEntry(Section):
    """Maker-specific entry of type `type` that sets a drive's watchdog; it is written and read back."""

    index: Annotated[int, Field(strict=True, ge=_MAKERS.start, lt=_MAKERS.stop)]
    sub: Annotated[int, Field(strict=True, ge=0, le=0xFF)] = 0
    type: Literal["i8", "u8", "i16", "u16", "i32", "u32"]
    value: Annotated[int, Field(strict=True)]

    @model_validator(mode="after")
    def _fits(self) -> WatchdogEntry:
        bits = int(self.type[1:])
        low, high = (0, 2**bits) if self.type.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        if not low <= self.value < high:
            raise ValueError(f"{self.value} is no {self.type}")
        return self


class Heartbeats(GrownSection):
    """Heartbeats of host and drives: periods and timeouts [s] (1017h, 1016h).

    Drives whose watchdog it is wait for the host's for `host_timeout`, which is `timeout` where it is left out.
    """

    node: NodeId = 127
    period: Seconds = 0.1
    drives: Seconds = 0.1
    timeout: Seconds = 0.3
    host_timeout: Seconds | None = None
    later = frozenset({"host_timeout"})

    @property
    def waits(self) -> float:
        """Return how long drives wait for the host's heartbeat [s]."""
        return self.timeout if self.host_timeout is None else self.host_timeout

    @model_validator(mode="after")
    def _patient(self) -> Heartbeats:
        if self.timeout <= max(self.period, self.drives):
            raise ValueError(f"a timeout of {self.timeout:g} s is not longer than the heartbeats' periods")
        if self.waits <= self.period:
            raise ValueError(f"drives that wait for {self.waits:g} s would miss a heartbeat every {self.period:g} s")
        return self


class NodeGuarding(Section):
    """Timing of `watchdog: node_guarding`: every `period` [s] (100Ch), of which `factor` may be missed (100Dh)."""

    period: Seconds = 0.02
    factor: Annotated[int, Field(strict=True, ge=2, le=255)] = 3
