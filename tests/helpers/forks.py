"""Processes that are this one as it stands, where starting an interpreter is not what a test is about."""

from __future__ import annotations

import asyncio
import atexit
import faulthandler
import fcntl
import gc
import inspect
import logging
import os
import runpy
import signal
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn


def fork() -> int:
    """Fork; 0 in the child, which must end by `os._exit`."""
    with warnings.catch_warnings():
        # Python 3.12 warns of the threads of a test runner; no child here takes their locks.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        gc.freeze()  # what the parent has made is not looked through again, nor copied for that
    return child


# Programs of the product that other programs of it start.
_PROGRAMS = {
    "ident_service",
    "ident_service.motion.process",
    "ident_service.operations.target_process",
    "ident_service.recordings.recorder_main",
    "drivers.can.frame_log_process",
    "sim_backend.plant_process",
}


class ForkedPopen(subprocess.Popen[Any]):
    """Start our own programs with their modules already imported, and all others as `subprocess.Popen` does.

    A program that begins by `execve` spends half a second of processor time on imports before its first line. Here the
    process is forked from this one, and has the pipes, descriptors, session, folder and environment that it would have;
    what it starts itself it starts likewise. Inherited are also the state of modules with the patches of a test, the
    libraries that are loaded, the command's words in /proc, and SQLite's own list of open files: a program that opens
    the registry which this process has open is told "locking protocol". Tests of such have `BEGIN_ANEW`.
    """

    def _execute_child(self, *given: Any) -> None:
        inherited = super()._execute_child  # type: ignore[misc]
        asked = inspect.signature(inherited).bind(*given).arguments
        program = _program_of(asked)
        if program is None:
            inherited(*given)
            return
        self.pid = fork()
        if self.pid == 0:
            _become(program, asked)
        self._child_created = True
        self._close_pipe_fds(*(asked[name] for name in _PIPES))  # type: ignore[attr-defined]


_PIPES = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")


def _program_of(asked: dict[str, Any]) -> list[str] | None:
    """Return module and words of a command that starts one of our programs without more ado; None of any other."""
    command = [os.fsdecode(word) for word in asked["args"]] if isinstance(asked["args"], (list, tuple)) else []
    words = [word for k, word in enumerate(command) if (k, word) != (1, "-P")]
    if words[:2] != [sys.executable, "-m"] or words[2:3] == [] or words[2] not in _PROGRAMS:
        return None
    plain = ("shell", "preexec_fn", "executable")
    return None if any(asked[name] for name in plain) or asked["gid"] is not None else words[2:]


def _become(program: Sequence[str], asked: dict[str, Any]) -> NoReturn:
    """Be the process that was asked for, to its end."""
    code = 1
    try:
        if asked["start_new_session"]:
            os.setsid()
        _take_descriptors(asked)
        if asked["cwd"] is not None:
            os.chdir(asked["cwd"])
        if asked["env"] is not None:
            os.environ.clear()
            os.environ.update({os.fsdecode(name): os.fsdecode(value) for name, value in asked["env"].items()})
        _as_at_the_start()
        sys.argv = ["", *program[1:]]
        try:
            runpy.run_module(program[0], run_name="__main__", alter_sys=True)
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
        except KeyboardInterrupt:
            traceback.print_exc()
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGINT)  # as an interpreter ends that nobody catches it in
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
    except BaseException:  # noqa: BLE001 - nothing may get back into the test that forked it
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:
                code = code or 120  # an interpreter's own, where its last words go nowhere
        os._exit(code)


def _take_descriptors(asked: dict[str, Any]) -> None:
    """Have the three streams and those that are passed on, and no other."""
    free = [None if asked[name] == -1 else fcntl.fcntl(asked[name], fcntl.F_DUPFD, 3) for name in _STREAMS]
    for number, one in enumerate(free):
        if one is not None:
            os.dup2(one, number)
    kept = sorted(asked["pass_fds"])
    most = os.sysconf("SC_OPEN_MAX")
    for first, last in zip([3, *(fd + 1 for fd in kept)], [*kept, most], strict=True):
        os.closerange(first, last)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - for as long as the process is
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
    sys.__stdin__, sys.__stdout__, sys.__stderr__ = sys.stdin, sys.stdout, sys.stderr  # type: ignore[misc]


_STREAMS = ("p2cread", "c2pwrite", "errwrite")


def _as_at_the_start() -> None:
    """Undo what a test runner does to an interpreter."""
    faulthandler.disable()
    atexit._clear()
    asyncio._set_running_loop(None)
    signal.set_wakeup_fd(-1)
    for number in signal.valid_signals() - {signal.SIGINT, signal.SIGPIPE, signal.SIGKILL, signal.SIGSTOP}:
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.excepthook, threading.excepthook = sys.__excepthook__, threading.__excepthook__
    logging.root.handlers.clear()
    logging.root.setLevel(logging.WARNING)
    warnings.resetwarnings()
    for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", kind)
    warnings.filterwarnings("ignore", category=RuntimeWarning, module="runpy")
