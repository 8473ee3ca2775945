"""Run one of our modules on an untrusted file, with limits of memory and time; it answers with JSON."""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from ident_service.errors import ModelError


def module_command(module: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """Return command and environment to run one of our modules in a new Python interpreter; start nothing.

    What this interpreter finds where, the other one finds there too, and never in the working directory first.
    """
    paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
    environment = {**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"}
    return [sys.executable, "-P", "-m", module, *arguments], environment


def run_limited_process(module: str, file: Path, timeout: float, *arguments: str) -> dict[str, Any]:
    """Run a module on a file in a limited process and return the JSON object it prints; ModelError if it breaks off.

    Args:
        module: module whose `main` calls `print_json_within_limits`.
        file: of the file.
        arguments: further arguments after the file's path.
        timeout: how long a busy machine may take [s]; the process limits its own computing.

    Raises:
        ModelError: it takes too long or breaks off; without the file's name.
    """
    command, environment = module_command(module, str(file), *arguments)
    try:
        done = subprocess.run(  # noqa: S603 - our own interpreter and module
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            timeout=timeout,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ModelError(f"could not be read and judged within {timeout:g} s; give a smaller one") from None
    if done.returncode == 0:
        answer: dict[str, Any] = json.loads(done.stdout)
        return answer
    if done.returncode == -signal.SIGXCPU:
        raise ModelError("takes too long to read and judge; give a smaller one")
    raise ModelError("breaks what reads it: a name twice, a name that is reserved, or too much memory; mend it")


ENDS_WITH_INPUT: Final = "IDENT_ENDS_WITH_INPUT"  # in the environment of a command whose starter it must not outlive
_PR_SET_PDEATHSIG = 1  # of prctl(2)


def end_with_input() -> None:
    """Start a thread that kills this process when its standard input ends; unset `ENDS_WITH_INPUT`, whatever it is."""
    os.environ.pop(ENDS_WITH_INPUT, None)  # of this command, and not of what it starts

    def wait() -> None:
        with suppress(OSError):
            while os.read(0, 4096):
                pass
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait, name="input", daemon=True).start()


def end_with_parent(parent_pid: int) -> None:
    """Have the kernel kill this process (SIGKILL) when the thread that started it ends; exit if it has ended.

    Args:
        parent_pid: id of the process that started this one; if that is gone already, this one ends at once.
    """
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent_pid:
        os._exit(1)


def print_json_within_limits(max_bytes: int, max_seconds: int, make_document: Callable[[], dict[str, Any]]) -> int:
    """Limit memory and computing time of this process, print the JSON of `make_document()`, and return 0.

    Args:
        max_bytes: bytes of addresses that it may have, libraries included.
        max_seconds: largest computing time [s].
        make_document: function without arguments that returns a JSON object.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (max_bytes, max_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (max_seconds, max_seconds + 1))
    answer = os.dup(1)
    os.dup2(2, 1)
    text = json.dumps(make_document()).encode()
    with os.fdopen(answer, "wb") as out:
        out.write(text)
    return 0
