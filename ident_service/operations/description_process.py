"""Judge an uploaded description as a separate program; `judge_apart` runs it within limits.

The daemon has loaded the description by then, within the limits of size; this process does the computations on its
model.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

from ident_service.errors import ConfigError, IdentError, ModelError, Problem
from ident_service.model.limited_process import answer_within, run_limited_process

MOST_MEMORY: Final = 2 * 2**30  # bytes of address space
MOST_SECONDS: Final = 20  # s of CPU time; ordinary arms take one
_DEADLINE = 60.0  # s


def judge_apart(path: Path) -> dict[str, Any]:
    """Judge an uploaded description in a separate process.

    Returns:
        `arm`, `sha256`, `good`, `stable`, `objections` and `text`.

    Raises:
        ConfigError: its mistakes.
        ModelError: any other error of it, or judging it takes too long or crashes.
    """
    try:
        answer = run_limited_process("ident_service.operations.description_process", path, _DEADLINE)
    except ModelError as error:
        raise ModelError(f"{path.name}: {error}") from None
    if (problems := answer.get("problems")) is not None:
        raise ConfigError([Problem(Path(where), line, column, said) for where, line, column, said in problems])
    if (error_text := answer.get("error")) is not None:
        raise ModelError(error_text)
    return answer


def _document(path: str) -> dict[str, Any]:
    from ident_service.operations.description_check import check_description, description_text

    try:
        checked = check_description(path, upload=True)
    except ConfigError as error:
        return {"problems": [[str(one.path), one.line, one.column, one.message] for one in error.problems]}
    except IdentError as error:
        return {"error": str(error)}
    gains = checked.gains
    return {
        "arm": checked.model.config.name,
        "sha256": checked.model.config.sha256,
        "stable": None if gains is None else gains.stable,
        "good": checked.good,
        "objections": [f"{one.line}:{one.column}: {one.message}" for one in checked.objections],
        "text": description_text(Path(path).name, checked),
    }


def main(words: list[str]) -> int:
    """Judge the description file that the first argument names."""
    return answer_within(MOST_MEMORY, MOST_SECONDS, lambda: _document(words[0]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
