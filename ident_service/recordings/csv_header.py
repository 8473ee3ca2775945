"""Parse the header of a CSV recording: which column is which quantity in which unit, or all that is wrong with it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ident_service.config.recording import Column
from ident_service.errors import RecordingError

_MOST_COLUMNS: Final = 4096
_NAME: Final = re.compile(r"(q|dq|tau)([1-9]\d{0,3})")


@dataclass(frozen=True)
class CsvColumns:
    """Hold the column index, and the scale to SI, of each quantity in a row.

    Attributes:
        names: of all columns, as the file has them.
        time: index of the time.
        position: indices of the positions, joint 1 first, shape (joints,).
        torque: indices of the torques, shape (joints,).
        velocity: indices of the velocities, shape (joints,), or None.
        nanoseconds: in one unit of the time column.
        scale: factor from each column's unit to SI, shape (fields,); None where all are in SI.
        used: indices of all columns above, in the order of the file.
    """

    names: tuple[str, ...]
    time: int
    position: NDArray[np.intp]
    torque: NDArray[np.intp]
    velocity: NDArray[np.intp] | None
    nanoseconds: Decimal
    scale: NDArray[np.float64] | None
    used: tuple[int, ...]

    @property
    def fields(self) -> int:
        """Return the number of fields in a row."""
        return len(self.names)

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return len(self.position)


def parse_header(path: Path, header: str, columns: Mapping[str, Column] | None = None) -> CsvColumns:
    """Find the columns of a recording in its header.

    Args:
        path: for messages.
        header: the first line.
        columns: the file's column for each standard name, where it has others; None reads standard names, in SI.

    Raises:
        RecordingError: the message lists all problems.
    """
    names = tuple(name.strip() for name in header.split(","))
    if not header.strip():
        raise RecordingError(path, "is empty; expected a header t,q1..qN,tau1..tauN")
    if len(names) > _MOST_COLUMNS:
        raise RecordingError(path, f"line 1: {len(names)} columns; a recording has {_MOST_COLUMNS} at most")
    problems = [f"column {name!r} appears twice" for name, count in sorted(Counter(names).items()) if count > 1]
    if columns is None:
        place = {name: index for index, name in enumerate(names)}
    else:
        problems += [f"no column {one.column!r} for {ours}" for ours, one in columns.items() if one.column not in names]
        place = {ours: names.index(one.column) for ours, one in columns.items() if one.column in names}
    numbers: dict[str, set[int]] = {"q": set(), "dq": set(), "tau": set()}
    for name in place:
        if match := _NAME.fullmatch(name):
            numbers[match[1]].add(int(match[2]))
        elif name != "t":
            problems.append(f"unknown column {name!r}")
    if "t" not in place:
        problems.append("no column 't' (time in seconds)")
    joints = max((number for found in numbers.values() for number in found), default=0)
    if joints == 0:
        problems.append("no joints")
    for kind, found in numbers.items():
        missing = [f"{kind}{number}" for number in range(1, joints + 1) if number not in found]
        if missing and (found or kind != "dq"):
            more = f" and {len(missing) - 8} more" if len(missing) > 8 else ""
            problems.append(f"missing {', '.join(missing[:8])}{more}")
    if problems:
        raise RecordingError(path, f"line 1: {'; '.join(problems)}; expected a header t,q1..qN,tau1..tauN")

    def indices(kind: str) -> NDArray[np.intp]:
        return np.array([place[f"{kind}{number}"] for number in range(1, joints + 1)], np.intp)

    velocity = indices("dq") if numbers["dq"] else None
    nanoseconds, scale = Decimal(10**9), np.ones(len(names))
    for ours, one in (columns or {}).items():
        if ours == "t":
            # Powers of ten and short decimals, as they are written: times keep all their digits.
            nanoseconds *= Decimal(repr(one.scale(ours)))
        else:
            scale[place[ours]] = one.scale(ours)
    return CsvColumns(
        names=names,
        time=place["t"],
        position=indices("q"),
        torque=indices("tau"),
        velocity=velocity,
        nanoseconds=nanoseconds,
        scale=None if (scale == 1.0).all() else scale,
        used=tuple(sorted(place.values())),
    )
