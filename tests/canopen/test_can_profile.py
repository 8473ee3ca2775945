"""Which frames flow, and what each drive has to be told for it."""

from __future__ import annotations

import pytest
from can_arms import wam_driver

from drivers.canopen import object_dictionary as od
from drivers.canopen.pdo_mapping import BusProfile, Write, bus_profiles
from ident_service.config.canopen import CanopenDriver

# CiA 301, table "restricted COB-IDs": of no PDO, SYNC or EMCY that can be configured.
RESTRICTED = (
    *((0x000, 0x000), (0x001, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x7FF)),
)


def profile(**changes: object) -> BusProfile:
    (only,) = bus_profiles(wam_driver(**changes), 1000.0)
    return only


def values(one: BusProfile, node: int, index: int) -> list[tuple[int, int]]:
    """Sub-index and value of every write to one index, in order."""
    return [(write.entry.sub, write.value) for write in writes(one, node) if write.entry.index == index]


def writes(one: BusProfile, node: int) -> list[Write]:
    """Everything that a drive would be told that has nothing of it."""
    pdos = [write for pdo in one.pdos(node) for write in pdo.writes()]
    off = [pdo.off for pdo in one.unused_pdos(node)]
    return [*one.identifiers(node), *off, *pdos, one.heartbeat(node), *one.host_supervision(node)]


def test_the_wam_has_two_shared_torque_frames() -> None:
    frames = profile().torque_frames
    assert [(frame.cob_id, frame.nodes, frame.length) for frame in frames] == [
        (0x201, (1, 2, 3, 4), 8),
        (0x205, (5, 6, 7), 6),
    ]


@pytest.mark.parametrize(
    ("node", "cob_id", "slots"),
    [
        (1, 0x201, [0x60710010, 0x00030010, 0x00030010, 0x00030010]),
        (4, 0x201, [0x00030010, 0x00030010, 0x00030010, 0x60710010]),
        (6, 0x205, [0x00030010, 0x60710010, 0x00030010]),
    ],
)
def test_a_drive_maps_its_slot_and_dummies_for_the_others(node: int, cob_id: int, slots: list[int]) -> None:
    one = profile()
    assert values(one, node, 0x1600) == [(0, 0), *enumerate(slots, 1), (0, len(slots))]
    # Off first, on last; the deadline in between.
    assert values(one, node, 0x1400) == [(1, 0x8000_0000 | cob_id), (2, 1), (5, 10), (1, cob_id)]
    mapped = [write for write in writes(one, node) if write.entry.index == 0x1600 and write.entry.sub]
    assert sum(write.value & 0xFF for write in mapped) == 8 * one.torque_frames[cob_id == 0x205].length


def test_single_frames_map_one_torque() -> None:
    one = profile(torque_frames="single")
    assert values(one, 6, 0x1600) == [(0, 0), (1, 0x60710010), (0, 1)]
    assert values(one, 6, 0x1400)[-1] == (1, 0x206)


def test_the_other_pdos_are_as_the_profile_says() -> None:
    one = profile(status={"period": 0.08, "inhibit": 0.02})
    assert values(one, 3, 0x1601) == [(0, 0), (1, 0x60400010), (2, 0x60600008), (0, 2)]
    assert values(one, 3, 0x1401) == [(1, 0x8000_0303), (2, 255), (1, 0x303)]
    assert values(one, 3, 0x1A00) == [(0, 0), (1, 0x60640020), (0, 1)]
    assert values(one, 3, 0x1800) == [(1, 0xC000_0183), (2, 1), (1, 0x4000_0183)]
    assert values(one, 3, 0x1A01) == [(0, 0), (1, 0x60410010), (2, 0x60770010), (0, 2)]
    assert values(one, 3, 0x1801) == [(1, 0xC000_0283), (2, 255), (3, 200), (5, 80), (1, 0x4000_0283)]
    for index in (0x1402, 0x1403, 0x1802, 0x1803):
        ((sub, value),) = values(one, 3, index)
        assert sub == 1
        assert value & 0x8000_0000
    assert values(one, 3, 0x1016) == [(1, 127 << 16 | 300)]
    assert values(one, 3, 0x1017) == [(0, 100)]


def test_every_write_fits_its_type() -> None:
    for write in writes(profile(), 7):
        assert write.entry.unpack(write.data) == write.value


@pytest.mark.parametrize("frames", ["shared", "single"])
def test_no_node_number_ever_leads_to_a_restricted_or_double_identifier(frames: str) -> None:
    drive = wam_driver().drives[0]
    for host, nodes in ((127, range(1, 127)), (1, range(2, 128))):
        driver = CanopenDriver.model_validate(
            {
                "kind": "canopen",
                "eds": {"name": "x", "text": ""},
                "torque_frames": frames,
                "heartbeats": {"node": host},
                "drives": [{**drive.model_dump(), "node": node} for node in nodes],
            }
        )
        (one,) = bus_profiles(driver, 100.0)
        used = {(pdo.cob_id, pdo.number, pdo.sent) for node in nodes for pdo in one.pdos(node)}
        assert not any(low <= cob_id <= high for cob_id, _, _ in used for low, high in RESTRICTED)
        assert len({cob_id for cob_id, _, _ in used}) == len(used)


def test_two_buses_have_their_own_frames() -> None:
    drives = [{**drive.model_dump(), "bus": k // 4, "node": k % 4 + 1} for k, drive in enumerate(wam_driver().drives)]
    first, second = bus_profiles(wam_driver(drives=drives, buses=[{}, {"channel": "can1"}]), 1000.0)
    assert (first.drives, second.drives) == ((0, 1, 2, 3), (4, 5, 6))
    assert [frame.drives for frame in second.torque_frames] == [(4, 5, 6)]
    assert second.torque_frames[0].cob_id == 0x201


def test_a_node_of_nobody_has_no_pdos() -> None:
    with pytest.raises(KeyError):
        profile().pdos(9)


def test_entries_pack_what_their_type_holds() -> None:
    assert od.TARGET_TORQUE.pack(-2) == b"\xfe\xff"
    assert od.MODE.unpack(b"\xff") == -1
    with pytest.raises(ValueError, match="6071h"):
        od.TARGET_TORQUE.pack(32_768)
    with pytest.raises(ValueError, match="3 bytes"):
        od.POSITION.unpack(bytes(3))
