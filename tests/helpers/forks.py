"""Processes that are this one as it stands, where starting an interpreter is not what a test is about."""

from __future__ import annotations

import atexit
import concurrent.futures.thread
import contextvars
import ctypes
import faulthandler
import fcntl
import functools
import gc
import importlib
import importlib.util
import logging
import multiprocessing.process
import multiprocessing.resource_tracker
import multiprocessing.util
import os
import pickle
import pkgutil
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import traceback
import types
import warnings
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NoReturn

import pytest

from ident_service import cli, daemon, operations

# What our own code starts by `-m`. Not there: processes that limit their memory, which this one may have taken already;
# but for the one that judges uploads, whose gigabytes leave room beside the modules of a server.
PROGRAMS: Final = frozenset(
    {
        "ident_service",
        "ident_service.daemon.jobs.socket_activation",
        "ident_service.motion.process",
        "ident_service.operations.description_process",
        "ident_service.operations.target_process",
        "ident_service.recordings.recorder_main",
        "drivers.can.frame_log_process",
        "sim_backend.plant_process",
    }
)
_parents: list[object] = []  # in a fork
_PYTHON: Final = sys.executable  # where a test names another one, that one is started


def fork() -> int:
    """Fork; 0 in the child, which must end by `os._exit`."""
    with warnings.catch_warnings():
        # Python 3.12 warns of the threads of a test runner; no child here takes their locks.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        gc.freeze()  # what the parent has made is not looked through again, nor copied for that
    return child


class ForkedProcess(subprocess.Popen[Any]):
    """`subprocess.Popen`, whose children that run one of `PROGRAMS` by `-m` have all modules imported already.

    Such a child is a process like any other, with the descriptors, folder, environment, session and signals that it
    would have, and so are its own children; it has not spent half a second on an interpreter and its imports. It has
    this process' command line in `/proc`, and what a test has put in the place of functions is there as well.
    """

    _forks_daemons = False

    def _execute_child(self, args: Any, *rest: Any) -> None:
        # Since Python 3.11: executable, preexec_fn, close_fds, pass_fds, cwd, env, startupinfo, creationflags, shell,
        # six ends of pipes, restore_signals, gid, gids, uid, umask, start_new_session, process_group.
        words = [] if isinstance(args, str | bytes | os.PathLike) else [os.fsdecode(word) for word in args]
        if words[:1] == [_PYTHON]:
            begin = 2 if words[1:2] == ["-P"] else 1
            usual = rest[:2] == (None, None) and rest[2] and not rest[8] and rest[16:20] == (None, None, None, -1)
            module = words[begin + 1 : begin + 3] if words[begin : begin + 1] == ["-m"] else []
            known = module[:1] and module[0] in PROGRAMS and (self._forks_daemons or module[1:] != ["serve"])
            if usual and rest[21] == -1 and known:
                self._fork(words[begin + 1 :], *rest)
                return
        super()._execute_child(args, *rest)  # type: ignore[misc]

    def _fork(self, words: list[str], *rest: Any) -> None:
        pass_fds, cwd, env, ends, own_session = rest[3], rest[4], rest[5], rest[9:15], rest[20]
        environment = None if env is None else {os.fsdecode(name): os.fsdecode(value) for name, value in env.items()}
        if cwd is not None:
            Path(cwd).stat()  # a folder that is not there is the caller's error
        ready, prepared = os.pipe()
        start = _Start(words, (ends[0], ends[3], ends[5]), (*pass_fds, prepared), cwd, environment, own_session)
        with os.fdopen(ready, "rb") as told:
            self.pid = self._fork_as(start)
            os.close(prepared)
            told.read()  # its end: now it has its own session, descriptors and signals, as after `exec`
        self._child_created = True
        self._close_pipe_fds(*ends)  # type: ignore[attr-defined]

    def _fork_as(self, start: _Start) -> int:
        """Fork a child that runs the program, and return its process id."""
        child = fork()
        if child == 0:
            start.go()
        return child


@dataclass(frozen=True)
class _Start:
    """Hold what a program begins with: its words, descriptors, folder, environment and session."""

    words: list[str]
    streams: tuple[int, int, int]  # what becomes 0, 1 and 2; -1: as they are
    others: tuple[int, ...]  # which keep their numbers; the last one is closed when all is as after `exec`
    folder: str | os.PathLike[str] | None
    environment: dict[str, str] | None
    own_session: bool
    registry: bool = False  # whether it may open one

    def go(self) -> NoReturn:
        """Be the program."""
        try:
            if self.own_session:
                os.setsid()
            if self.folder is not None:
                os.chdir(self.folder)
            _keep_only(*self.streams, self.others)
            _forget_the_parent(self.environment)
            if not self.registry:
                # SQLite knows in each process which files that has locked; a fork would believe to have those locks.
                sqlite3.connect = _no_registry
            if self.words[:2] == ["ident_service", "serve"]:
                subprocess.Popen = served_by(ForkServer())  # type: ignore[misc]
            os.close(self.others[-1])
            contextvars.Context().run(_be, *self.words)
        finally:
            os._exit(255)


class ForkServer:
    """Forks programs for a process with threads, a daemon's, whose locks a fork of its own would have.

    It is itself forked from the tests before there is any daemon. The programs are children of the tests all the same:
    each is forked by a process that ends at once, while the tests are whom the kernel gives such children to.
    """

    def __init__(self) -> None:
        self._link, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._lock = threading.Lock()
        self._pid = fork()
        if self._pid == 0:
            try:
                _serve(its)
            finally:
                os._exit(255)
        its.close()

    def start(self, start: _Start) -> int:
        """Return the process id of a new child of this process."""
        umask = re.findall(r"(?m)^Umask:\s*(\d+)$", Path("/proc/self/status").read_text())[0]
        streams = tuple(number if fd == -1 else fd for number, fd in enumerate(start.streams))
        whole = replace(
            start,
            streams=streams,
            folder=start.folder or Path.cwd(),
            environment=dict(os.environ) if start.environment is None else start.environment,
            registry=True,
        )
        with self._lock:
            _adopt_orphans(True)
            try:
                socket.send_fds(self._link, [pickle.dumps((whole, int(umask, 8)))], [*streams, *start.others])
                answer = self._link.recv(100)
            finally:
                _adopt_orphans(False)
        return int(answer)

    def close(self) -> None:
        """End the server; programs go on."""
        self._link.close()
        os.waitpid(self._pid, 0)


def _adopt_orphans(yes: bool) -> None:
    """Have the kernel make orphans among this process' descendants its children (`PR_SET_CHILD_SUBREAPER`)."""
    assert ctypes.CDLL(None).prctl(36, int(yes), 0, 0, 0) == 0


def _serve(link: socket.socket) -> None:
    """Fork what is asked for, until nobody can ask any more."""
    os.setsid()  # an interrupt from the keyboard is the tests'
    nothing = os.open(os.devnull, os.O_RDWR)
    _keep_only(nothing, nothing, nothing, [link.fileno()])
    subprocess.Popen = ForkedProcess  # type: ignore[misc]  # of programs that start others
    while True:
        request, received, _, _ = socket.recv_fds(link, 1 << 20, 250)
        if not request:
            return
        _load_all()
        start, umask = pickle.loads(request)  # noqa: S301 - our own parent's
        named, waits = os.pipe()
        middle = fork()
        if middle == 0:
            child = fork()
            if child:
                os.write(waits, str(child).encode())
                os._exit(0)
            os.umask(umask)
            _placed(start, received).go()
        os.close(waits)
        for fd in received:
            os.close(fd)
        os.waitpid(middle, 0)  # now the program has been adopted
        link.send(os.read(named, 100))
        os.close(named)


@functools.cache
def _load_all() -> None:
    """Import what programs import when they come to it: once, and not in each."""
    for package in (cli, daemon, operations):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(found.name)


def _placed(start: _Start, received: list[int]) -> _Start:
    """Give the descriptors that were received the numbers that they have where they come from."""
    beyond = max(*received, *start.others) + 1
    copies = [fcntl.fcntl(fd, fcntl.F_DUPFD, beyond) for fd in received]
    for fd, number in zip(copies[3:], start.others, strict=True):
        os.dup2(fd, number)
    return replace(start, streams=(copies[0], copies[1], copies[2]))


def _keep_only(stdin: int, stdout: int, stderr: int, others: Sequence[int]) -> None:
    """Have these three descriptors as 0, 1, 2 (-1: as they are) and of all others only those that are passed on."""
    copies = [-1 if fd == -1 else fcntl.fcntl(fd, fcntl.F_DUPFD, 3) for fd in (stdin, stdout, stderr)]
    for number, fd in enumerate(copies):
        if fd != -1:
            os.dup2(fd, number)
    kept = sorted(others)
    for first, last in zip([3, *(fd + 1 for fd in kept)], [*kept, os.sysconf("SC_OPEN_MAX")], strict=True):
        os.closerange(first, last)


def _forget_the_parent(environment: dict[str, str] | None) -> None:
    """Put back what a new interpreter begins with: signals, streams, warnings, hooks, what is done at the end."""
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    signal.set_wakeup_fd(-1)
    faulthandler.disable()
    # What the parent's objects do at their end or at the interpreter's is the parent's to do; they stay, as the numbers
    # of the files that they would close are other files' now.
    atexit._clear()
    registries: tuple[Any, ...] = (
        weakref.finalize._registry,  # type: ignore[attr-defined]
        concurrent.futures.thread._threads_queues,  # type: ignore[attr-defined]
    )
    _parents.extend([*map(dict, registries), sys.stdin, sys.stdout, sys.stderr, sys.__stdin__, sys.__stdout__])
    _parents.extend([sys.__stderr__, sys.modules["__main__"], *logging.root.handlers])
    for registry in registries:
        registry.clear()
    weakref.finalize._registered_with_atexit = False  # type: ignore[attr-defined]
    multiprocessing.process._children.clear()  # type: ignore[attr-defined]
    multiprocessing.util._finalizer_registry.clear()  # type: ignore[attr-defined]
    atexit.register(multiprocessing.util._exit_function)
    tracker = multiprocessing.resource_tracker._resource_tracker
    tracker._fd = tracker._pid = None  # type: ignore[attr-defined]
    if environment is not None:
        os.environ.clear()
        os.environ.update(environment)
    for number, name, mode, errors in (
        (0, "stdin", "r", "strict"),
        (1, "stdout", "w", "strict"),
        (2, "stderr", "w", "backslashreplace"),
    ):
        stream = open(number, mode, encoding="utf-8", errors=errors, closefd=False)  # noqa: SIM115
        stream.reconfigure(line_buffering=number == 2 or stream.isatty())
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    warnings.resetwarnings()
    for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", kind)
    sys.excepthook, sys.unraisablehook = sys.__excepthook__, sys.__unraisablehook__
    threading.excepthook = threading.__excepthook__
    for handler in list(logging.root.handlers):
        logging.root.removeHandler(handler)
    logging.root.setLevel(logging.WARNING)
    gc.enable()


def _no_registry(*_: object, **__: object) -> NoReturn:
    raise AssertionError("a program that opens the registry is to be started, not forked: tests/conftest.py")


def _be(program: str, *words: str) -> NoReturn:
    """Run a module as `python -m` does, and end."""
    spec = importlib.util.find_spec(program)
    if spec is not None and spec.submodule_search_locations is not None:
        spec = importlib.util.find_spec(f"{program}.__main__")
    assert spec is not None
    assert spec.origin is not None
    main = types.ModuleType("__main__")
    main.__file__, main.__spec__ = spec.origin, spec
    sys.modules["__main__"] = main
    sys.argv = [spec.origin, *words]
    code = 0
    try:
        exec(spec.loader.get_code(spec.name), main.__dict__)  # type: ignore[union-attr]  # noqa: S102
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:  # noqa: BLE001 - whatever it is, an interpreter ends with its traceback
        traceback.print_exc()
        code = 1
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            code = 120
    os._exit(code)


def served_by(server: ForkServer) -> type[ForkedProcess]:
    """Return a `ForkedProcess` whose children a server forks, daemons too."""

    class ServedProcess(ForkedProcess):
        _forks_daemons = True

        def _fork_as(self, start: _Start) -> int:
            return server.start(start)

    return ServedProcess


def fork_processes(patch: pytest.MonkeyPatch, server: ForkServer | None = None) -> None:
    """Have our own programs that are started from here forked from this process, or by a server."""
    patch.setattr(subprocess, "Popen", ForkedProcess if server is None else served_by(server))


def start_processes(patch: pytest.MonkeyPatch) -> None:
    """Have programs started anew where a module's are forked."""
    patch.setattr(subprocess, "Popen", ForkedProcess.__base__)
