"""Whoever moves an arm of a state folder, reached over its control file: a job of ours, a terminal, anybody."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ident_service.errors import UsageError
from ident_service.motion.control_file import ControlFile, mover
from ident_service.service.arm_state import control_path


def stop_arms(state: Path, arm: str | None) -> list[str]:
    """Bring an arm, or all, to a controlled stop, and let no motion begin that was asked for; names of those reached.

    Args:
        state: the state folder.
        arm: its name; None for all that ever moved.
    """
    return _reach(state, arm, ControlFile.stop_all)


def pause_arm(state: Path, arm: str, *, wanted: bool) -> bool:
    """Let an arm stand, or go on; whether anybody moves it."""
    return bool(_reach(state, arm, _asking(lambda controls: controls.ask_pause(wanted))))


def finish_arm(state: Path, arm: str) -> bool:
    """Let a run end early, in order, out of a pause too; whether anybody moves the arm."""

    def ask(controls: ControlFile) -> None:
        controls.ask_finish()
        controls.ask_pause(False)

    return bool(_reach(state, arm, _asking(ask)))


def confirm_support(state: Path, arm: str) -> bool:
    """Let an arm that is held after a stop go, since a person sees it supported; whether one was held."""
    return bool(_reach(state, arm, _asking(ControlFile.confirm_support)))


def moving_arms(state: Path) -> list[str]:
    """Names of the arms that anybody moves."""
    return _reach(state, None, mover)


def _asking(ask: Callable[[ControlFile], None]) -> Callable[[Path], int]:
    def asked(path: Path) -> int:
        with ControlFile.reach(path) as controls:
            ask(controls)
            return controls.pid

    return asked


def _reach(state: Path, arm: str | None, act: Callable[[Path], int | None]) -> list[str]:
    place = state / "arms"
    there = [path.name for path in place.iterdir()] if place.is_dir() else []
    reached = []
    for name in there if arm is None else [arm] if arm in there else []:
        with suppress(UsageError):  # nobody moves it
            if act(control_path(state, name)) is not None:
                reached.append(name)
    return sorted(reached)
