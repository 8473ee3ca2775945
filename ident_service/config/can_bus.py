"""Describe one CAN bus and the interface that gives access to it, for every driver that has one."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from ident_service.config.quantities import Count, Section

_KERNELS = ("raw", "socketcan")  # two ways to access the same kernel interfaces
WIRE_INTERFACE = "ident_wire"  # a bus that is a program on this computer, for emulated drives in real time


class CanBus(Section):
    """One CAN bus, and the interface that gives access to it."""

    interface: Annotated[str, Field(min_length=1)] = "socketcan"
    """python-can's name of an interface; `raw` for a CAN socket of the kernel without python-can; `lock_step` for
    emulated drives in this process and in virtual time."""
    channel: str = "can0"
    """Name of the bus at that interface."""
    bitrate: Annotated[Count, Field(le=1_000_000)] = 1_000_000
    """Bit rate [bit/s]."""
    data_bitrate: Count | None = None
    """Bit rate of the data of CAN FD frames [bit/s]; classic CAN when left out."""
    options: dict[str, str | int | float | bool] = Field(default_factory=dict)
    """Further options of python-can's interface."""

    @property
    def medium(self) -> str:
        """Return the namespace of `channel`: `kernel` for interfaces `raw` and `socketcan`, else the interface."""
        return "kernel" if self.interface in _KERNELS else self.interface

    @model_validator(mode="after")
    def _data_not_slower(self) -> CanBus:
        if self.data_bitrate is not None and self.data_bitrate < self.bitrate:
            raise ValueError(f"data_bitrate {self.data_bitrate} is below bitrate {self.bitrate}; CAN FD only speeds up")
        return self
