"""Verify a parameter file's certificate, against its own conditions or those of an arm."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ident_service.certificate_verifier import Arm, Verification, VerificationError, read_file, verify_path
from ident_service.errors import UsageError

if TYPE_CHECKING:
    from ident_service.config.arm import ArmConfig

_FILE = "parameters.json"
# Sections of a description that say nothing about bodies; an identification may have used others, which its file names.
_CHANGEABLE = frozenset({"identification", "recording", "driver"})


def verify_file(certified_file: Path, description: str | None = None) -> Verification:
    """Check a certificate in exact arithmetic against an arm's conditions, or else the file's own; return the verdict.

    Args:
        certified_file: the file, or a folder of results.
        description: description whose conditions those of the file must be: a file, the name of a shipped one, or the
            `arm.json` of a folder of results. Without one, the file is held against its own conditions.

    Raises:
        UsageError: no such file, or one that cannot be read.
        ConfigError: the description has mistakes.
    """
    try:
        if description is None:
            return verify_path(certified_file)
        stated, custom = _arm(description, certified_file / _FILE if certified_file.is_dir() else certified_file)
        result = verify_path(certified_file, stated)
        if custom is None:
            return result
        return replace(result, message=f"{result.message}; {custom_note(custom)}")
    except OSError as error:
        raise UsageError(f"{error.filename or certified_file}: {error.strerror or error}") from None


def custom_note(function_name: str) -> str:
    """Return the note that an answer leaves out the function that `constraints.custom` of the description names."""
    return (
        f"constraints.custom ({function_name}) of the description is code that only identify and simulate run; "
        "left out here"
    )


def _arm(arm: str, file: Path) -> tuple[Arm, str | None]:
    """Return the conditions and expressions of a description, and the name of its custom constraints, if any."""
    # The numerical packages are loaded only where there is a description to make conditions from.
    from ident_service.config.load import arm_from_json, load_arm
    from ident_service.estimation.certificate import certificate_arm
    from ident_service.estimation.feasible.feasible_set import feasible_set
    from ident_service.model.arm_model import arm_model
    from ident_service.model.base_parameters import base_parameters

    config = arm_from_json(Path(arm)) if arm.endswith(".json") else load_arm(arm)
    model = arm_model(config)
    base = base_parameters(model.chain, model.layout)
    conditions = feasible_set("pseudo_inertia", base.names, config)
    stated = certificate_arm(
        config.name, _sha256(config, file), base, conditions, units=model.layout.units, joints=model.chain.names
    )
    return stated, config.constraints.custom


def _sha256(config: ArmConfig, file: Path) -> str:
    """Return the hash of the description with the sections that the file says it was identified with."""
    from pydantic import ValidationError

    from ident_service.config.arm import ArmConfig

    try:
        changes = json.loads(read_file(file))["arm"]["changes"]
    except (VerificationError, ValueError, KeyError, TypeError, RecursionError):
        return config.sha256
    if not isinstance(changes, dict) or not changes.keys() <= _CHANGEABLE:
        return config.sha256
    try:
        return ArmConfig.model_validate_json(json.dumps(json.loads(config.model_dump_json()) | changes)).sha256
    except ValidationError:
        return config.sha256
