"""Name what a state folder holds; keep it its owner's alone, and one daemon's at a time.

Whoever can enter it can read who did what, and can hold a byte of SQLite's write-ahead log that every write waits for.
What another user writes into it, root included, its owner's daemon could not open afterwards.
"""

from __future__ import annotations

import fcntl
import os
import pwd
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ident_service.errors import UsageError

if TYPE_CHECKING:  # brings drivers, and who keeps results moves no arm
    from ident_service.motion.fault_store import FaultStore

LOCK: Final = "serve.lock"
URL_FILE: Final = "serve.url"
RESTORING: Final = ".restoring"
"""Name of a folder that exists while a restore replaces the state."""
_OTHERS_ENTER = 0o011


def require_private(state: Path) -> None:
    """Raise UsageError if others can enter a state folder; set the umask so that only the owner reads new files.

    Args:
        state: the folder, there or not yet.

    Raises:
        UsageError: others can enter it, or it is somebody else's; the remedy is named.
    """
    os.umask(0o077)
    if (refusal := access_refusal(state, writing=True)) is not None:
        raise UsageError(refusal)
    path = state.resolve()
    if not path.is_dir():
        return
    # A parent folder that others cannot enter protects it, too.
    if all(place.stat().st_mode & _OTHERS_ENTER for place in (path, *path.parents)):
        raise UsageError(f"{state}: others can enter it, and read or block what is in it; close it: chmod 700 {path}")


def access_refusal(state: Path, *, writing: bool = False) -> str | None:
    """Return why a user must not use another's folder, even to read; None for one's own, open or new.

    Args:
        state: the folder.
        writing: whether files are to be made there, which are their maker's: root's would shut the owner out.
    """
    try:
        owner = state.stat().st_uid
    except PermissionError:
        return f"{state}: cannot be entered by {_user(os.geteuid())}; call `ident` as the user whose folder it is"
    except OSError:
        return None
    own = owner == os.geteuid()
    may = os.access(state, os.R_OK | os.W_OK | os.X_OK, effective_ids=True)
    if own or (may and not (writing and os.geteuid() == 0)):
        return None
    return (
        f"{state}: belongs to the user {_user(owner)}, not to {_user(os.geteuid())}, whose files they could not open; "
        f"call it as that user: sudo -u {_sudo_user(owner)} IDENT_STATE={state.absolute()} ident ..."
    )


def give_to_owner(state: Path, path: Path) -> None:
    """Give `path`, and the folders down to it, to the owner of the state folder; do nothing unless called by root.

    Args:
        state: the state folder.
        path: a file or folder in it, given away with the folders between the two.
    """
    if os.geteuid() != 0:
        return
    with suppress(OSError, ValueError):  # the act itself is done
        found = state.stat()
        parts = path.relative_to(state).parts
        for count in range(1, len(parts) + 1):
            place = state.joinpath(*parts[:count])
            if place.lstat().st_uid != found.st_uid:
                os.chown(place, found.st_uid, found.st_gid, follow_symlinks=False)


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def _sudo_user(number: int) -> str:
    name = _user(number)
    return f"'#{number}'" if name == str(number) else name


def require_no_interrupted_restore(state: Path) -> None:
    """Raise UsageError for a state folder in which a restore was interrupted.

    Raises:
        UsageError: a restore was interrupted.
    """
    if (state / RESTORING).exists():
        raise UsageError(f"{state}: a restore broke off here; run `ident restore` again, it loses nothing")


@contextmanager
def single_instance(state: Path) -> Iterator[None]:
    """Hold the state folder's lock during the block; raise UsageError at once if another process holds it.

    Raises:
        UsageError: another process holds it, or it cannot be made.
    """
    path = state / LOCK
    try:
        state.mkdir(mode=0o700, parents=True, exist_ok=True)
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise UsageError(f"{path}: cannot be made: {error.strerror}; give another state folder") from None
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            pid = os.pread(fd, 20, 0).decode("ascii", "replace").strip() or "unknown"
            raise UsageError(f"{state}: process {pid} serves this state folder already") from None
        os.ftruncate(fd, 0)
        os.pwrite(fd, str(os.getpid()).encode(), 0)
        yield
    finally:
        os.close(fd)


def arm_folder(state: Path, arm: str) -> Path:
    """Return the folder of one arm in the state folder."""
    return state / "arms" / arm


def known_arms(state: Path) -> list[str]:
    """Return the names of the arms that a state folder has files of."""
    place = state / "arms"
    return sorted(path.name for path in place.iterdir() if not path.name.startswith(".")) if place.is_dir() else []


def control_path(state: Path, arm: str) -> Path:
    """Return the path of the arm's control file (`motion/command_channel.py`)."""
    from ident_service.motion.fault_store import CONTROLS

    return arm_folder(state, arm) / CONTROLS


def ticket_path(state: Path, arm: str) -> Path:
    """Return the path of the arm's last preflight ticket."""
    return arm_folder(state, arm) / "ticket.json"


def arm_fault_store(state: Path, arm: str) -> FaultStore:
    """Return the store of the arm's faults that no person has acknowledged (`motion/fault_store.py`)."""
    from ident_service.motion.fault_store import FaultStore

    return FaultStore(arm_folder(state, arm))


def new_run_folder(state: Path, arm: str, parent_name: str = "runs") -> Path:
    """Return a free path for a new run in the state folder's subfolder `parent_name`; make nothing."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    folder, count = state / parent_name / f"{stamp}-{arm}", 1
    while folder.exists():
        count += 1
        folder = state / parent_name / f"{stamp}-{arm}-{count}"
    return folder
