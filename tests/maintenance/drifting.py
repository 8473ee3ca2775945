"""An arm that is accepted, changed in its plant or not, and re-identified by the command."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maintenance.conftest import ARM, description

from ident_service.cli import main
from ident_service.operations.drift_alarms import alarms
from ident_service.registry.database import Database, Row


@dataclass(frozen=True)
class Again:
    """What `ident reidentify --json` left."""

    code: int
    answer: dict[str, Any]
    alarms: list[Row]

    @property
    def names_the_elbow_alone(self) -> bool:
        """The verdict is a change of friction of the joint whose friction was changed, and of nothing else."""
        if (self.code, self.answer["verdict"], len(self.alarms)) != (3, "changed", 1):
            return False
        what = [one["what"] for one in self.answer["comparison"]["compared"][0]["findings"]]
        return what == ["friction of joint elbow"] and "friction of joint elbow" in self.alarms[0]["what"]


def reidentified(state: Path, seed: int, drier: float, printed: Callable[[], str]) -> Again:
    """Re-identify the arm of a state folder with a plant of this seed; `printed` is what went to stdout since."""
    path = state / f"seed{seed}.yaml"
    path.write_text(description(seed=seed, drier=drier))
    printed()
    code = main(["reidentify", str(path), "--confirm", ARM, "--by", "ann", "--json", "--state", str(state)])
    answer = json.loads(printed())
    with Database(state) as db:
        return Again(code, answer, alarms(db, ARM))
