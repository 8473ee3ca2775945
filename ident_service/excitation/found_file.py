"""Store a search on disk, so that it can be resumed: its candidates and a fingerprint of its task."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from ident_service.errors import UsageError
from ident_service.excitation.climb import Candidate
from ident_service.excitation.search import Found
from ident_service.excitation.task import Task

FORMAT, VERSION = "ident-search", 1
_MOST_BYTES = 16 * 2**20


def fingerprint(task: Task, seed: int) -> str:
    """Return the SHA-256 of everything that a search's random starts and its criterion depend on."""
    digest = hashlib.sha256()
    parts = (
        task.model.config.motion_sha256,
        repr(task.basis),
        task.criterion,
        json.dumps([task.columns.tolist(), None if task.chosen is None else task.chosen.tolist(), seed, task.rate]),
    )
    for part in parts:
        digest.update(part.encode() + b"\0")
    limits = [task.limits.lower, task.limits.upper, task.limits.torque]
    limits += [] if task.limits.motors is None else [task.limits.motors.torque]
    for array in (task.model.prior, task.scale, task.noise, task.added, *limits):
        digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def found_to_json(found: Found, task: Task) -> str:
    """Return the results of a search as one JSON object."""
    return json.dumps(
        {
            "format": FORMAT,
            "version": VERSION,
            "task_sha256": fingerprint(task, found.seed),
            "seed": found.seed,
            "finished": found.finished,
            "seconds": found.seconds,
            "candidates": [
                {"start": one.start, "value": one.value, "coefficients": one.coefficients.tolist()}
                for one in found.candidates
                if np.isfinite(one.value)
            ],
        },
        indent=1,
        allow_nan=False,
    )


def read_found(file: Path, task: Task, seed: int) -> Found:
    """Read a search that is to be resumed.

    Args:
        file: what `found_to_json` made.
        task: that it shall go on with.
        seed: likewise.

    Raises:
        UsageError: no such file, not a search, or the search of another task.
    """
    shape = (task.model.chain.joints, task.basis.size)
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise UsageError(f"{file}: larger than {_MOST_BYTES} bytes; not a search")
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["format"] != FORMAT or content["version"] != VERSION:
            raise UsageError(f"{file}: not a search that this software wrote")
        if content["task_sha256"] != fingerprint(task, seed):
            raise UsageError(
                f"{file}: a search with another arm, criterion, margin, seed or motion; give the same ones, or leave "
                "--resume out"
            )
        candidates = tuple(
            Candidate(int(one["start"]), float(one["value"]), np.array(one["coefficients"], dtype=float))
            for one in content["candidates"]
        )
        finished, seconds = int(content["finished"]), float(content["seconds"])
    except OSError as error:
        raise UsageError(f"{file}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"{file}: not a search: {error}") from None
    if any(not (np.abs(one.coefficients) < 1e6).all() or not np.isfinite(one.value) for one in candidates):
        raise UsageError(f"{file}: not a search: a number that no arm can mean")
    if finished < 0 or any(one.coefficients.shape != shape for one in candidates):
        raise UsageError(f"{file}: not a search for motions of {shape[0]} joints with {shape[1]} coefficients")
    return Found(seed, finished, seconds, candidates)
