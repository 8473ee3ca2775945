"""WAM-like drives for the tests of this folder."""

from __future__ import annotations

from typing import Any

from ident_service.config.canopen import CanopenDriver
from ident_service.config.recording import Transmission

EDS = "[FileInfo]\nFileName=emulated.eds\n\n[DummyUsage]\nDummy0001=0\nDummy0003=1\n\n[6077]\nParameterName=Torque\n"
# Newton metres at the motor: FIELDBUS.md 1.1, counts of MT over counts per newton metre.
MAX_TORQUE = (1.8, 1.8, 1.8, 1.6, 0.6, 0.6, 0.0916)
RATED = (0.2, 0.2, 0.2, 0.2, 0.1, 0.1, 0.02)
RATIOS = (-42.0, 28.25, -28.25, -18.0, 9.7, 9.7, -14.93)
COUPLING = (
    (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, -1 / 1.68, 0.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 1 / 1.68, 0.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 0.0, 1.0, -1.0, 0.0),
    (0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
)


def wam_driver(**changes: Any) -> CanopenDriver:
    """The WAM's seven drives as nodes 1 to 7 of one bus; keys of the section `driver` may be changed."""
    drives = [
        {"node": k + 1, "rated_torque": RATED[k], "max_torque": MAX_TORQUE[k], "max_speed": 5000.0} for k in range(7)
    ]
    content = {"kind": "canopen", "eds": {"name": "emulated_drive.eds", "text": EDS}, "drives": drives}
    return CanopenDriver.model_validate({**content, **changes})


def wam_transmission() -> Transmission:
    """The WAM's two differentials and seven gears."""
    return Transmission(ratios=RATIOS, coupling=COUPLING)
