"""Complete words at a shell's prompt: verbs, options, choices, and the arms, runs, jobs and motions that exist.

The shell starts `ident` with `_ARGCOMPLETE` set and the line typed so far; argcomplete answers from the parser. Names
are those of folders in the state folder, and of a read of the registry that waits for nobody; or they are asked of a
daemon, where the line has `--server`. A name that cannot be found out is not offered, and no message disturbs the line.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from ident_service.cli.arguments import Parser
from ident_service.cli.output import state_folder
from ident_service.errors import IdentError, UsageError

VARIABLE = "_ARGCOMPLETE"
"""Environment variable by which a shell asks for completions."""
SHELLS = ("bash", "zsh", "fish")
_MOST = 50  # names offered, the newest first
_JOBS, _UPLOADED = "SELECT id FROM jobs ORDER BY number DESC LIMIT 50", "SELECT name FROM arms"


def install_completion(shell: str, *, install: bool) -> tuple[str, Path | None]:
    """Return (completion script for bash, zsh or fish, file that it was written to if `install`, else None).

    Args:
        shell: `bash`, `zsh` or `fish`.
        install: whether to write it where the shell looks for it.

    Raises:
        UsageError: zsh looks into no folder of its own.
    """
    from argcomplete.shell_integration import shellcode

    script = str(shellcode(["ident"], use_defaults=False, shell=shell))
    if not install:
        return script, None
    if shell == "zsh":
        raise UsageError('zsh has no such folder of its own; add this line to ~/.zshrc: eval "$(ident completion zsh)"')
    data = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    config = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    place = f"{data}/bash-completion/completions/ident" if shell == "bash" else f"{config}/fish/completions/ident.fish"
    path = Path(place).expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(script, encoding="utf-8")
    return script, path


def complete(top: Parser) -> None:
    """Answer a shell's completion request and end the process; return if this process was not started for one."""
    import argcomplete

    for parser in _prune(top):
        for action in parser._actions:
            if action.option_strings and action.nargs == 0:
                continue
            action.completer = _completer(parser, action)  # type: ignore[attr-defined]
    argcomplete.autocomplete(top, always_complete_options="long")


def _prune(parser: Parser) -> Iterator[Parser]:
    """Yield a parser and those of its verbs; take away the former names, which are not to be offered."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name in set(action.choices) - set(parser.shown):
                del action.choices[name]
            for sub in action.choices.values():
                yield from _prune(sub)


def _completer(parser: Parser, action: argparse.Action) -> Any:
    from argcomplete.completers import FilesCompleter

    if action.choices is not None or isinstance(action, argparse._SubParsersAction):
        return None
    kind = parser.get_default("kind")
    names = _NAMES.get(f"{kind}s" if action.dest == "name" and kind else action.dest)
    files = action.type is Path or action.metavar in _FILES
    if names is None:
        return FilesCompleter() if files else lambda **_: ()

    def offered(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> Iterable[str]:
        found = _found(names, parsed_args)
        return [*found, *(FilesCompleter()(prefix) if files else ())]

    return offered


def _found(names: Callable[[Path, Any, argparse.Namespace], list[str]], parsed: argparse.Namespace) -> list[str]:
    import sqlite3

    for key in ("state", "server", "word", "arm"):
        setattr(parsed, key, getattr(parsed, key, None))
    try:
        if parsed.server is None:
            return names(state_folder(parsed), None, parsed)
        from ident_service.cli.remote import connection

        with closing(connection(parsed)) as client:
            return names(Path(), client, parsed)
    except (IdentError, OSError, sqlite3.Error):
        return []


def _arms(state: Path, client: Any, _: argparse.Namespace) -> list[str]:
    if client is not None:
        return [row["name"] for row in client.get("/api/v1/arms")]
    from ident_service.config.yaml_source import shipped_arms
    from ident_service.registry.state_folder import known_arms

    return sorted({*shipped_arms(), *known_arms(state), *_rows(state, _UPLOADED)})


def _runs(state: Path, client: Any, _: argparse.Namespace) -> list[str]:
    return _folders(state / "runs") if client is None else _ids(client, "runs")


def _motions(state: Path, client: Any, _: argparse.Namespace) -> list[str]:
    return _folders(state / "motions") if client is None else _ids(client, "motions")


def _jobs(state: Path, client: Any, _: argparse.Namespace) -> list[str]:
    return _rows(state, _JOBS) if client is None else _ids(client, "jobs")


def _faults(state: Path, client: Any, parsed: argparse.Namespace) -> list[str]:
    if client is not None:
        return [row["code"] for row in client.get(f"/api/v1/arms/{parsed.arm}/faults")]
    from ident_service.registry.state_folder import arm_fault_store

    return list(arm_fault_store(state, str(parsed.arm)).latched())


def _ids(client: Any, kind: str) -> list[str]:
    return [row["id"] for row in client.get(f"/api/v1/{kind}?most={_MOST}")]


def _folders(place: Path) -> list[str]:
    names = [path.name for path in place.iterdir() if not path.name.startswith(".")] if place.is_dir() else []
    return sorted(names, reverse=True)[:_MOST]


def _rows(state: Path, query: str) -> list[str]:
    """Read one column of the registry; none where there is no registry, or where it is locked."""
    import sqlite3

    from ident_service.registry.database import FILE

    path = (state / FILE).absolute()
    if not path.is_file():
        return []
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True, timeout=0.2)) as db:
        return [str(name) for (name,) in db.execute(query)]


_NAMES: dict[str, Callable[[Path, Any, argparse.Namespace], list[str]]] = {
    **dict.fromkeys(("arm", "arms", "file"), _arms),
    **dict.fromkeys(("run", "runs", "recordings", "reference", "others"), _runs),
    **dict.fromkeys(("motion", "motions"), _motions),
    "job": _jobs,
    "fault": _faults,
}
_FILES = frozenset({"ARM", "FILE", "DIR", "PATH", "MOTION", "RECORDING", "PATTERN", "DCF"})
