"""Frames to draw, an arm on a bus to configure, and processes on a wire to kill."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from hypothesis import strategies as st

from drivers.can.can_frame import FD_LENGTHS, Frame
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from sim_backend.can_bus.hub import CanBusServer
from sim_backend.can_bus.link import Connection, WireLink
from sim_backend.can_bus.packets import Hello

PATIENCE = 30.0


def soon() -> int:
    """A deadline that a working link never needs [ns]."""
    return time.monotonic_ns() + round(PATIENCE * 1e9)


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.002)


def content(frame: Frame | None) -> Frame | None:
    return None if frame is None else frame._replace(stamp_ns=0)


def greeted(wire: CanBusServer, count: int) -> None:
    """Wait until so many ends are on the wire."""
    wait_for(lambda: len(wire.medium.ports) == count)


@st.composite
def frames(draw: st.DrawFn, *, fd: bool = False, errors: bool = False) -> Frame:
    """Frames that exist on a bus."""
    kind = draw(st.sampled_from(["data", "data", "remote", "error"] if errors else ["data", "data", "remote"]))
    if kind == "error":
        return Frame(draw(st.integers(0, 0x1FFF_FFFF)), draw(st.binary(min_size=8, max_size=8)), error=True)
    extended = draw(st.booleans())
    identifier = draw(st.integers(0, 0x1FFF_FFFF if extended else 0x7FF))
    size = draw(st.sampled_from(sorted(FD_LENGTHS) if fd else range(9)))
    data = b"" if kind == "remote" else draw(st.binary(min_size=size, max_size=size))
    is_fd = fd and kind == "data" and (size > 8 or draw(st.booleans()))
    return Frame(identifier, data, kind == "remote", extended=extended, fd=is_fd)


def arm_on_bus(**bus: Any) -> ArmConfig:
    """The planar arm with two drives on one bus."""
    drive = {"rated_torque": 1.0, "max_torque": 2.0, "max_speed": 3000.0}
    config = load_arm("planar2").model_dump()
    driver = {
        "kind": "canopen",
        "eds": {"name": "emulated_drive.eds", "text": ""},
        "buses": [bus],
        "drives": [{"node": 1, **drive}, {"node": 2, **drive}],
    }
    return ArmConfig.model_validate(config | {"driver": driver, "transmission": {"ratios": [40.0, 20.0]}})


def end_of(name: str, label: str = "test", **hello: Any) -> WireLink:
    """A link on a wire."""
    return WireLink(Connection(name, Hello(label, **hello)))


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A Python process that says `ready` on its first line; killed at the end if it still runs."""
    child = subprocess.Popen(
        [sys.executable, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ
    )
    try:
        assert child.stdout is not None
        assert child.stdout.readline().strip() == "ready"
        yield child
    finally:
        child.kill()
        child.wait()
        for pipe in (child.stdin, child.stdout):
            if pipe is not None:
                pipe.close()
