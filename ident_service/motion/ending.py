"""Write the report of how a run ended into its folder; a run without that file was killed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from ident_service.recordings.files import write_atomically

ENDED: Final = "ended.json"


def write_ending(folder: Path, document: dict[str, Any]) -> None:
    """Write `document`, the report of how a run ended, as JSON into its folder; it replaces an earlier one.

    Raises:
        UsageError: the folder cannot be written.
    """
    write_atomically(folder / ENDED, json.dumps(document, indent=1) + "\n")
