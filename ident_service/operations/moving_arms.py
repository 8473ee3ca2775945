"""Reach the process that moves an arm of a state folder over its control file, whoever started it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ident_service.errors import UsageError
from ident_service.motion.command_channel import ControlFile, controlling_pid
from ident_service.registry.state_folder import control_path


def stop_arms(state: Path, arm: str | None) -> list[str]:
    """Bring an arm, or all, to a controlled stop and block motions asked for before; return the arms reached.

    Args:
        state: the state folder.
        arm: its name; None for all that ever moved.
    """
    return _reach(state, arm, ControlFile.stop_all)


def pause_arm(state: Path, arm: str, *, wanted: bool) -> bool:
    """Pause an arm, or let it go on (`wanted` False); return whether a process moves it."""
    return bool(_reach(state, arm, _command_of(lambda controls: controls.request_pause(wanted))))


def finish_arm(state: Path, arm: str) -> bool:
    """End a run early by its regular end, out of a pause too; return whether a process moves the arm."""

    def ask(controls: ControlFile) -> None:
        controls.request_finish()
        controls.request_pause(False)

    return bool(_reach(state, arm, _command_of(ask)))


def confirm_support(state: Path, arm: str) -> bool:
    """Release an arm held after a stop, since a person sees it supported; return whether one was held."""
    return bool(_reach(state, arm, _command_of(ControlFile.confirm_support)))


def held_arm(state: Path, arm: str) -> bool:
    """Tell whether an arm without brakes is held after a stop until a person confirms that it is supported."""
    try:
        with ControlFile.reach(control_path(state, arm)) as controls:
            return controls.waiting
    except UsageError:  # nobody moves or holds it
        return False


def moving_arms(state: Path) -> list[str]:
    """Return the names of the arms that any process moves."""
    return _reach(state, None, controlling_pid)


def _command_of(ask: Callable[[ControlFile], None]) -> Callable[[Path], int]:
    def send(path: Path) -> int:
        with ControlFile.reach(path) as controls:
            ask(controls)
            return controls.pid

    return send


def _reach(state: Path, arm: str | None, act: Callable[[Path], int | None]) -> list[str]:
    place = state / "arms"
    there = [path.name for path in place.iterdir()] if place.is_dir() else []
    reached = []
    for name in there if arm is None else [arm] if arm in there else []:
        with suppress(UsageError):  # no process moves it
            if act(control_path(state, name)) is not None:
                reached.append(name)
    return sorted(reached)
