"""Do what a newcomer does: run the commands of documents, as they stand there, in a new folder.

    python tests/documents/walk.py README.md docs/tutorial.md     with this checkout's environment, on quicker arms
    python tests/documents/walk.py --clean README.md ...          in a clean clone with an environment of its own

A page is a script. Blocks of `sh` and Python are run in their order. A block whose first line is a comment with the
name of a file, or that stands behind `<!-- file: NAME -->`, is that file. `# exit code 3` behind a command says what it
ends with, `0 or 3` that both are right. A block behind `<!-- walk: skip, WHY -->` is for people only; before one behind
`<!-- walk: first COMMAND -->`, that command makes what a reader has already. `make` makes the environment, so its lines
are left to `--clean`. A URDF, `robot.urdf`, is at hand, as a newcomer's is.
"""

from __future__ import annotations

import argparse
import array
import importlib
import json
import os
import pkgutil
import re
import shlex
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"(?m)(?:^<!-- (?P<mark>[^\n]+) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$", re.DOTALL)
EXIT_CODE = re.compile(r"#.*?exit code (\d)(?: or (\d))?")
PACKAGES = ("ident_service", "drivers", "sim_backend", "configs")
PORT = "8470"  # of the daemon in the documents


@dataclass(frozen=True)
class Block:
    """A block of a document: its language, its text, the line that it begins in, its file, and what is done before."""

    language: str
    text: str
    line: int
    file: str | None = None
    first: str = ""


def blocks(page: str) -> Iterator[Block]:
    """Yield the blocks that are to be run or written, in their order."""
    for found in BLOCK.finditer(page):
        mark, text, language = found["mark"] or "", found["text"], found["language"]
        if mark.startswith("walk: skip"):
            continue
        named = re.match(r"file: (\S+)$", mark) or re.match(r"# ([\w-]+\.(?:yaml|csv|json))\n", text)
        if named or language in ("sh", "python"):
            line, first = page.count("\n", 0, found.start("text")) + 1, mark.partition("walk: first ")[2]
            yield Block(language, text, line, named[1] if named else None, first)


def lines_of(text: str) -> Iterator[tuple[int, str]]:
    """Yield the commands of a block with the number of their first line; a backslash continues one."""
    whole, first = "", 0
    for number, line in enumerate(text.splitlines()):
        first = first if whole else number
        whole += line
        if whole.endswith("\\"):
            whole = whole[:-1] + " "
            continue
        if whole.strip():
            yield first, whole
        whole = ""


def script(pages: Sequence[Path]) -> str:
    """Return the pages as one script of bash, which ends at the first command that does not end as its page says."""
    parts = [
        'ended() { case " $2 " in *" $1 "*) ;; *) echo "$3: exit code $1 instead of $2" >&2; exit 1;; esac; }',
        "trap 'kill $(jobs -p) 2>/dev/null' EXIT",
    ]
    for page in pages:
        for block in blocks(page.read_text(encoding="utf-8")):
            parts += _commands(block, page.name)
    return "\n".join(parts) + "\n"


def _commands(block: Block, page: str) -> Iterator[str]:
    """Yield the commands of one block."""
    if block.first:
        yield f"{block.first}\nended $? 0 {shlex.quote(f'{page}:{block.line}: {block.first}')}"
    if block.file is not None or block.language == "python":
        name = block.file or f"{page}-{block.line}.py"
        yield f"cat > {shlex.quote(name)} <<'END_OF_BLOCK'\n{block.text}END_OF_BLOCK"
        if block.file is None:
            yield f"python {shlex.quote(name)}\nended $? 0 {shlex.quote(f'{page}:{block.line}')}"
        return
    for number, line in lines_of(block.text):
        if line.startswith("make ") or line.lstrip().startswith("#"):
            continue
        place = f"{page}:{block.line + number}: {line}"
        yield f"echo {shlex.quote('+ ' + line)}\n{line}"
        if not line.split("#")[0].rstrip().endswith("&"):
            codes = next((found.groups() for found in EXIT_CODE.finditer(line)), ("0",))
            yield f"ended $? {shlex.quote(' '.join(filter(None, codes)))} {shlex.quote(place)}"


def quicker(text: str) -> str:
    """Return the description of `planar2` at an eighth of its rate, with motions of half the length."""
    for old, new in (
        ("base_frequency: 0.1", "base_frequency: 0.2"),
        ("following_error: 0.2, home: 0, kp: 400, kd: 40", "following_error: 0.4, home: 0, kp: 225, kd: 30"),
        ("  delay_cycles: 1\n", "  delay_cycles: 1\n  watchdog: 0.016\n"),
    ):
        if old not in text:
            raise ValueError(f"planar2.yaml has no {old!r} any more")
        text = text.replace(old, new)
    return text + "control: {rate: 125}\ndesign: {base_frequency: 0.2, harmonics: 2, periods: 2, ramp: 0.5}\n"


def shipped_copy(folder: Path, *, quick: bool) -> Path:
    """Copy what is shipped, compiled files included, as it is or with quicker arms; return where it is.

    Quicker are `planar2` and what `ident new` writes, whose rate is halved.
    """
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package)
    arm, new = folder / "configs" / "planar2.yaml", folder / "ident_service" / "operations" / "new_description.py"
    if quick:
        arm.write_text(quicker(arm.read_text(encoding="utf-8")), encoding="utf-8")
        text, changed = re.subn(r"(?m)^RATE = 500\.0 ", "RATE = 250.0 ", new.read_text(encoding="utf-8"))
        if changed != 1:
            raise ValueError(f"{new.name} has no rate of 500 Hz any more")
        new.write_text(text, encoding="utf-8")
    return folder


def clean_clone(folder: Path) -> Path:
    """Clone the last commit and make its environment, as a newcomer does; return the environment's commands."""
    subprocess.run(["git", "clone", "--quiet", ROOT, folder / "ident"], check=True)
    subprocess.run(["make", "demo"], cwd=folder / "ident", check=True)
    return folder / "ident" / ".venv" / "bin"


CLIENT = """import array, json, os, socket, sys
with socket.socket(socket.AF_UNIX) as server:
    server.connect({path!r})
    words = json.dumps([os.getcwd(), sys.argv[1:]]).encode()
    server.sendmsg([words], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [0, 1, 2]))])
    sys.exit(server.recv(1)[0])
"""
"""The command `ident` of a walk: hands its words, folder and streams to `serve_commands`."""


def serve_commands(path: str) -> None:
    """Run commands in forks of this process, which has loaded everything: loading costs more than most of them take."""
    from ident_service import cli, operations

    for package in (cli, operations):
        for found in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            importlib.import_module(found.name)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path)
        listener.listen()
        while True:
            asking, _ = listener.accept()
            with suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass
            words, ancillary, *_ = asking.recvmsg(65536, socket.CMSG_SPACE(12))
            streams = array.array("i", ancillary[0][2])
            if os.fork() == 0:
                asking.sendall(bytes([_ended(*json.loads(words), streams)]))
                os._exit(0)
            for stream in streams:
                os.close(stream)
            asking.close()


def _ended(folder: str, words: list[str], streams: Sequence[int]) -> int:
    """Run one command in a fork; return its exit code."""
    if (child := os.fork()) != 0:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) & 255
    from ident_service.cli import main as ident

    code = 1
    try:
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
        os.chdir(folder)
        sys.argv = ["ident", *words]
        code = ident(words)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    finally:
        if (error := sys.exc_info()[1]) is not None:
            traceback.print_exception(error)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def walk(
    pages: Sequence[Path], folder: Path, *, clean: bool = False, quick: bool = True, quiet: bool = True
) -> subprocess.CompletedProcess[str]:
    """Run the commands of pages in a new folder below another one.

    Args:
        pages: in the order in which they are read.
        folder: where everything is made.
        clean: in a clean clone with an environment of its own, instead of this one with quicker arms.
        quick: whether arms are quicker ones, and not as they are shipped.
        quiet: whether the output is kept for the caller, instead of being shown.

    Returns:
        What became of the script.
    """
    tools, work = folder / "tools", folder / "work"
    tools.mkdir(parents=True)
    work.mkdir()
    environment = {**os.environ, "IDENT_STATE": str(folder / "state"), "MPLBACKEND": "agg"}
    path, serving = "", None
    if clean:
        environment["PATH"] = f"{clean_clone(folder)}{os.pathsep}{environment['PATH']}"
        source, text = folder / "ident", script(pages)
    else:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = str(free.getsockname()[1])
        source, text = shipped_copy(folder / "checkout", quick=quick), script(pages).replace(f":{PORT}", f":{port}")
        environment |= {"PYTHONPATH": str(source), "PATH": f"{tools}{os.pathsep}{environment['PATH']}"}
        path = str(folder / "commands")
        program = shlex.quote(sys.executable)
        (tools / "client.py").write_text(CLIENT.format(path=path))
        serve = f'[ "$1" != serve ] || exec {program} -m ident_service "$@" --port {port}\n'
        client = f'exec {program} -I -S {shlex.quote(str(tools / "client.py"))} "$@"'
        for name, command in (("ident", serve + client), ("python", f'exec {program} "$@"')):
            (tools / name).write_text(f"#!/bin/sh\n{command}\n")
            (tools / name).chmod(0o755)
        serving = subprocess.Popen([sys.executable, __file__, "--serve", path], env=environment, cwd=work)
    shutil.copy(source / "configs" / "threelink.urdf", work / "robot.urdf")
    to = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT} if quiet else {}
    try:
        while serving is not None and serving.poll() is None and not Path(path).exists():
            time.sleep(0.02)
        return subprocess.run(
            ["bash", "-c", text], cwd=work, env=environment, stdin=subprocess.DEVNULL, text=True, check=False, **to
        )
    finally:
        if serving is not None:
            serving.kill()
            serving.wait()


def main() -> int:
    """Walk through the pages that are named, in a folder that is kept when something fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="*", type=Path)
    parser.add_argument("--clean", action="store_true", help="in a clean clone with an environment of its own")
    parser.add_argument("--print", action="store_true", help="print the script and run nothing")
    parser.add_argument("--serve", metavar="SOCKET", help=argparse.SUPPRESS)
    words = parser.parse_args()
    if words.serve:
        serve_commands(words.serve)
    if words.print:
        print(script(words.pages))
        return 0
    folder = Path(tempfile.mkdtemp(prefix="walk-"))
    done = walk(words.pages, folder, clean=words.clean, quiet=False)
    if done.returncode:
        print(f"see {folder}", file=sys.stderr)
    else:
        shutil.rmtree(folder)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
