"""Register and run the verbs about the daemon, `serve` and `tokens`, and `completion`, about the shell."""

from __future__ import annotations

import argparse
from pathlib import Path

from ident_service.cli.answer_texts import answer_of
from ident_service.cli.archive_commands import add_by, registry, terminal_user
from ident_service.cli.arguments import VerbList
from ident_service.cli.completion import SHELLS, install_completion
from ident_service.cli.output import DONE, Answer, print_to_person, state_folder

_PORT = 8470


def add(verbs: VerbList) -> None:
    """Register `serve`, `tokens`, `tokens add`, `tokens revoke` and `completion`."""
    sub = verbs.add(
        "serve",
        _serve,
        "start the daemon: pages, HTTP API, jobs and schedules",
        examples=("", "--port 0", "--host 0.0.0.0 --tls-cert chain.pem --tls-key key.pem"),
    )
    sub.add_argument("--host", default="127.0.0.1", help="address to listen on; other than loopback needs TLS")
    sub.add_argument("--port", type=_port, default=_PORT, help=f"default {_PORT}; 0 for any that is free")
    sub.add_argument("--tls-cert", type=Path, metavar="FILE", help="certificate chain, PEM")
    sub.add_argument("--tls-key", type=Path, metavar="FILE", help="its key, PEM")
    sub.add_argument("--name", action="append", default=[], metavar="HOST", help="further host name that clients use")
    sub.add_argument("--motion-socket", type=Path, metavar="SOCKET", help="of the unit that motions run in")
    sub.add_argument("--motion-door", dest="motion_socket", type=Path, help=argparse.SUPPRESS)  # former name

    sub.add_argument(
        "--webhook",
        metavar="URL",
        help="receives notices of due re-identifications and drift; https, or http to this machine",
    )
    sub.add_argument(
        "--webhook-secret", type=Path, metavar="FILE", help="file with the secret that signs notices; chmod 600"
    )

    tokens = verbs.group(
        "tokens",
        "list the daemon's access tokens; add, revoke",
        _list,
        former="token",
        examples=("", "--server http://127.0.0.1:8470"),
    )
    sub = tokens.add(
        "add", _add, "create a token and print it once", examples=("ann --role operator", "wall --role viewer")
    )
    sub.add_argument("name", metavar="NAME", help="shown in the audit log")
    sub.add_argument("--role", choices=["viewer", "operator"], required=True)
    add_by(sub)
    tokens.add("list", _list, "list names and roles", hidden=True, stands_for="tokens")
    sub = tokens.add(
        "revoke", _revoke, "revoke a token and its sessions", examples=("ann", "ann --server http://127.0.0.1:8470")
    )
    sub.add_argument("name", metavar="NAME")
    add_by(sub)
    sub = verbs.add(
        "completion",
        _completion,
        "print or install completion for bash, zsh or fish",
        more='For one shell: `eval "$(ident completion bash)"`, and in zsh; fish: `ident completion fish | source`.',
        examples=("bash", "zsh", "fish --install"),
    )
    sub.add_argument("shell", choices=SHELLS)
    sub.add_argument("--install", action="store_true", help="write it where the shell looks for it (bash, fish)")


def _completion(arguments: argparse.Namespace) -> Answer:
    script, path = install_completion(arguments.shell, install=arguments.install)
    text = script if path is None else f"{path}: written; a new {arguments.shell} completes `ident`\n"
    document = {"shell": arguments.shell, "script": script, "file": None if path is None else str(path)}
    return DONE, text, document


def _serve(arguments: argparse.Namespace) -> Answer:
    from ident_service.daemon.serve import log_as_json, serve
    from ident_service.daemon.settings import Settings

    state = state_folder(arguments).absolute()
    settings = Settings(
        state,
        host=arguments.host,
        port=arguments.port,
        tls_cert=arguments.tls_cert,
        tls_key=arguments.tls_key,
        names=tuple(arguments.name),
        motion_socket=arguments.motion_socket,
        webhook=arguments.webhook,
        webhook_secret=arguments.webhook_secret,
    )
    log_as_json()
    serve(settings, lambda url: print_to_person(f"ident: {url}, state {state}, token in {state / 'token'}\n"))
    return DONE, "", {"state": str(state)}


def _add(arguments: argparse.Namespace) -> Answer:
    from ident_service.registry.tokens import add_token

    with registry(arguments, arms=False) as (db, _):
        secret = add_token(db, arguments.name, arguments.role, terminal_user(arguments))
    return DONE, f"{secret}\n", {"name": arguments.name, "role": arguments.role, "token": secret}


def _list(arguments: argparse.Namespace) -> Answer:
    from ident_service.registry.tokens import tokens

    with registry(arguments, arms=False) as (db, _):
        rows = tokens(db)
    return answer_of(arguments, {"tokens": [dict(row) for row in rows]})


def _revoke(arguments: argparse.Namespace) -> Answer:
    from ident_service.registry.tokens import revoke_token

    with registry(arguments, arms=False) as (db, _):
        revoke_token(db, arguments.name, terminal_user(arguments))
    return answer_of(arguments, {"name": arguments.name, "revoked": True})


def _port(text: str) -> int:
    if not text.isdigit() or int(text) > 65535:
        raise argparse.ArgumentTypeError("a port is a number from 0 to 65535")
    return int(text)
