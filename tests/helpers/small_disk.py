"""A disk that is really full: a small file system of its own, which needs no privilege where users have namespaces."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

_SPACE = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c")


def run_on_small_disk(disk: Path, size: str, script: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a script of the shell while a file system of this size lies at `disk`, seen by nobody else.

    Args:
        disk: a folder, which is made.
        size: of the file system, in the words of tmpfs.
        script: for `sh -c`.
        words: for the script, from `$0` on.
    """
    disk.mkdir(exist_ok=True)
    mount = f"mount -t tmpfs -o size={size},mode=700 tmpfs '{disk}'"
    if subprocess.run([*_SPACE, mount], check=False, capture_output=True).returncode:
        pytest.skip("this kernel lets no user mount a file system")
    command = [*_SPACE, f"{mount} && {script}", *words]
    return subprocess.run(command, check=False, capture_output=True, text=True)
