"""The drive's own scaling (608Fh, 6091h) against the description's."""

from __future__ import annotations

import pytest
from helpers.emulated_arms import EDS, weightless_config

from drivers.canopen.driver import CanopenArm
from ident_service.errors import DriverError
from sim_backend.emulator.lock_step import LockStepArm

DRIVE = {"rated_torque": 1.0, "max_speed": 6000.0, "max_torque": 5.0}
GEAR = """
[6091]
ParameterName=Gear ratio
ObjectType=0x8
SubNumber=3

[6091sub0]
ParameterName=Highest sub-index
ObjectType=0x7
DataType=0x0005
AccessType=const
DefaultValue=2
PDOMapping=0

[6091sub1]
ParameterName=Motor revolutions
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue={motor}
PDOMapping=0

[6091sub2]
ParameterName=Shaft revolutions
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=1
PDOMapping=0
"""


def opened(told: int, real: int, eds: str = EDS) -> None:
    """Open an arm whose second drive is told another number of counts than it has."""

    def drives(second: int) -> list[dict[str, float]]:
        return [DRIVE | {"node": 1, "counts": 4096}, DRIVE | {"node": 2, "counts": second}]

    behind = LockStepArm(weightless_config(drives=drives(real), eds={"name": "real.eds", "text": eds}))
    arm = CanopenArm(weightless_config(drives=drives(told)), lambda _: [behind.link(0)])
    with arm:
        assert arm.exchange(None).valid.all()


@pytest.mark.parametrize(("told", "ratio"), [(8192, "2"), (2048, "0.5"), (4095, "0.999")])
def test_counts_that_the_drive_contradicts_are_named_as_a_scale(told: int, ratio: str) -> None:
    with pytest.raises(DriverError, match=rf"node 2: a motor turn has 4096 counts by the drive \(608Fh\).*by {ratio}"):
        opened(told, 4096)


def test_counts_that_agree_and_lines_of_an_encoder_are_taken() -> None:
    opened(4096, 4096)
    opened(4096, 1024)  # lines, with four counts each


def test_a_drive_with_a_gear_of_its_own_tells_another_unit_and_one_without_608f_tells_none() -> None:
    geared = EDS.replace("\n[60B2]", GEAR.format(motor=10) + "\n[60B2]", 1)
    numbered = geared.replace("SupportedObjects=65", "SupportedObjects=66").replace("65=0x100D", "65=0x100D\n66=0x6091")
    opened(8192, 4096, numbered)
    plain = EDS.replace("\n[60B2]", GEAR.format(motor=1) + "\n[60B2]", 1)
    numbered = plain.replace("SupportedObjects=65", "SupportedObjects=66").replace("65=0x100D", "65=0x100D\n66=0x6091")
    with pytest.raises(DriverError, match="608Fh"):
        opened(8192, 4096, numbered)
