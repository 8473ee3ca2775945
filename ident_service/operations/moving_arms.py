"""Reach the process that moves an arm of a state folder over its control file, whoever started it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from ident_service.errors import DriverError, UsageError
from ident_service.motion.command_channel import ControlFile
from ident_service.registry.state_folder import control_path


def stop_arms(state: Path, arm: str | None) -> tuple[list[str], list[DriverError]]:
    """Request a controlled stop of an arm, or all, and of motions asked for before; return arms reached, and failures.

    Args:
        state: the state folder.
        arm: name of the arm; None for all that ever moved.

    Returns:
        The names of the arms that a process moves or holds; an error for each whose control file cannot be opened: it
        may move, and has NOT been stopped over that file.
    """
    return _reach(state, arm, ControlFile.stop_motions)


Asked = Literal["pause", "resume", "finish", "supported"]


def ask_process(control_file: Path, request: Asked) -> int:
    """Write a request into a control file for the process that holds it, do not wait; return that process's id.

    Args:
        control_file: path of the file.
        request: pause, or go on; finish a run early by its regular end, out of a pause too; or release an arm
            that is held after a stop, since a person sees it supported.

    Raises:
        UsageError: no process holds it.
        DriverError: the file cannot be opened.
    """
    with ControlFile.reach(control_file) as controls:
        if request == "supported":
            controls.confirm_support()
        else:
            if request == "finish":
                controls.request_finish()
            controls.request_pause(request == "pause")
        return controls.pid


def ask_arm(state: Path, arm: str, request: Asked) -> bool:
    """Send a request, such as `pause`, to the process that moves or holds an arm; return whether there was one.

    Raises:
        DriverError: the control file cannot be opened.
    """
    reached, failures = _reach(state, arm, lambda path: ask_process(path, request))
    for failure in failures:
        raise failure
    return bool(reached)


def is_held(state: Path, arm: str) -> bool:
    """Return whether an arm is seen to be held after a stop, until a person confirms that it is supported."""
    try:
        with ControlFile.reach(control_path(state, arm)) as controls:
            return controls.waiting
    except (UsageError, DriverError):  # nobody moves or holds it, or nobody can see that
        return False


def control_problem(state: Path, arm: str) -> str | None:
    """Return why it cannot be told whether an arm moves, and what to do; None where its control file can be opened."""
    try:
        with ControlFile.reach(control_path(state, arm)):
            return None
    except UsageError:  # no process moves it
        return None
    except DriverError as error:
        return str(error)


def moving_arms(state: Path) -> list[str]:
    """Return the names of the arms that any process moves or holds, or whose control file cannot be opened."""
    return _reach(state, None, _pid_if_any)[0]


def _pid_if_any(path: Path) -> int:
    try:
        with ControlFile.reach(path) as controls:
            return controls.pid
    except DriverError:
        return 0  # it may move


def _reach(state: Path, arm: str | None, act: Callable[[Path], int | None]) -> tuple[list[str], list[DriverError]]:
    place = state / "arms"
    there = [path.name for path in place.iterdir()] if place.is_dir() else []
    reached, failures = list[str](), list[DriverError]()
    for name in there if arm is None else [arm] if arm in there else []:
        try:
            if act(control_path(state, name)) is not None:
                reached.append(name)
        except DriverError as error:
            failures.append(error)
        except UsageError:  # no process moves it
            pass
    return sorted(reached), failures
