"""The columns file of an uploaded recording, and the header that it is about."""

from __future__ import annotations

import gzip
import tempfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ident_service.errors import ConfigError, Problem, UsageError
from ident_service.registry.runs import COLUMNS

if TYPE_CHECKING:
    from ident_service.config.recording import RecordingFormat
    from ident_service.config.schema import ArmConfig

LONGEST_HEADER: Final = 2**20  # bytes


def format_of(columns: str, name: str, config: ArmConfig) -> RecordingFormat:
    """Read the columns file of a recording as an identification will.

    Args:
        columns: content of the file.
        name: of the recording.
        config: of its arm.

    Raises:
        ConfigError, UsageError: as `recordings.own_formats`, without the place where it was read.
    """
    from ident_service.model.arm_model import arm_model
    from ident_service.operations.recordings import own_formats

    with tempfile.TemporaryDirectory(prefix="ident-columns.") as place:
        file, recording = Path(place) / COLUMNS, Path(name)
        file.write_text(columns, encoding="utf-8", errors="replace")
        try:
            return own_formats({recording: file}, [recording], arm_model(config))[recording]
        except ConfigError as error:
            raise ConfigError(
                [Problem(Path(COLUMNS), one.line, one.column, one.message) for one in error.problems]
            ) from None
        except UsageError as error:
            raise UsageError(str(error).replace(f"{place}/", "")) from None


def first_line(path: Path, *, packed: bool) -> bytes:
    """Return the first line as far as it is there, and as a reader takes it."""
    with path.open("rb") as stream:
        if not packed:
            return stream.readline(LONGEST_HEADER)
        try:
            with gzip.open(stream) as unpacked:
                return unpacked.readline(LONGEST_HEADER)
        except (EOFError, OSError, zlib.error):
            return b""
