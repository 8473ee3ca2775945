"""Load identified parameters from disk as a dynamic model, for `ident_service.results.load_model`."""

from __future__ import annotations

import hashlib
from pathlib import Path

from ident_service.config.arm import ArmConfig
from ident_service.config.load import arm_from_json, load_arm
from ident_service.errors import ModelError, ParameterError, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.model.dynamic_model import DynamicModel
from ident_service.results.export.identified_arm import IdentifiedArm, identified_arm, read_identified
from ident_service.results.parameter_file import read_parameters
from ident_service.results.run_folder import ARM, MANIFEST, PARAMETERS


def dynamic_model(path: Path, arm: str | Path | None) -> DynamicModel:
    """Return the dynamic model of identified parameters, friction included; ModelError where they are not feasible."""
    found = _identified(path, arm)
    if found.delta is None:
        raise ModelError(
            f"{path}: these parameters are not feasible, so there is no model; `ident project` gives the nearest "
            "feasible ones"
        )
    return DynamicModel(found.model, found.delta)


def _identified(path: Path, arm: str | Path | None) -> IdentifiedArm:
    file = path / PARAMETERS if path.is_dir() else path
    if arm is None and file.name == PARAMETERS and (file.parent / MANIFEST).is_file():
        return read_identified(file.parent)
    parameters = read_parameters(file)
    named = parameters.content.get("arm", {})
    beside = file.parent / ARM
    if arm is None and not beside.is_file():
        raise UsageError(f"{file}: there is no {ARM} beside it; name its arm")
    config = arm_from_json(beside) if arm is None else load_arm(arm)
    if arm is None and named and named["sha256"] != config.sha256:
        raise ParameterError(f"{file}: was identified for another arm than {beside} describes")
    joints = arm_model(config).chain.names
    if named and tuple(named["joints"]) != joints:
        raise ParameterError(f"{file}: is about the joints {', '.join(named['joints'])}, not those of {config.name}")
    source = hashlib.sha256(file.read_bytes()).hexdigest()
    return identified_arm(_as_identified(config, parameters.content, len(joints)), parameters, source, file)


def _as_identified(config: ArmConfig, content: dict[str, object], joints: int) -> ArmConfig:
    """Return the arm with the friction's shape that a parameter file was fitted with."""
    friction = content.get("friction")
    known = friction if isinstance(friction, dict) else {}
    fitted = {
        key: tuple(known[key]) for key in ("presliding", "stribeck_velocity") if len(known.get(key, ())) == joints
    }
    if not fitted:
        return config
    shape = config.identification.friction.model_copy(update=fitted)
    return config.model_copy(update={"identification": config.identification.model_copy(update={"friction": shape})})
