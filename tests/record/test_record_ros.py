"""Recordings as ROS 2 reads them: by `rosbags`, which shares no code with the writer."""

from __future__ import annotations

import json
import re
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from mcap.reader import make_reader
from record.record_samples import JOINTS, OFFSET_NS, START_NS, STEP_NS, position, read_all, write_recording
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from drivers.clock import RealClock, VirtualClock, utc_offset_of_recording_ns
from ident_service.config.load import load_arm
from ident_service.errors import UsageError
from ident_service.model.appearance import visible_bodies
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.collision import link_bodies
from ident_service.model.solids import Capsule
from ident_service.model.urdf import urdf_text
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.mcap_writer import CYCLE, DEFINITIONS, DIFFERENCE, RecordingWriter, root_link

PACKAGE = Path(__file__).resolve().parents[2] / "ros" / "ident_msgs"
MESSAGE = PACKAGE / "msg" / "Cycle.msg"


@pytest.fixture(scope="module")
def types() -> Typestore:
    """ROS 2 Humble and the package `ident_msgs`."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(MESSAGE.read_text(), CYCLE))
    return store


@pytest.fixture(scope="module")
def wam() -> ArmModel:
    return arm_model(load_arm("wam7_sim"))


def test_ros_replays_every_message_in_order_and_latches_the_description(
    tmp_path: Path, types: Typestore, wam: ArmModel
) -> None:
    path, urdf = tmp_path / "run.mcap", urdf_text(wam, wam.prior, visible_bodies(wam))
    names, count = wam.chain.names, 300
    with RecordingWriter(path, names, urdf, OFFSET_NS) as writer:
        for k in range(count):
            q, flags = position(k, 7), np.ones(7, bool)
            writer.sample(
                Cycle(START_NS + k * STEP_NS, q, None, q + 1, q + 2, q + 3, k, 5, 6, flags, np.zeros(7, int), 0, q + 4)
            )
            if k == 100:
                writer.event(START_NS + k * STEP_NS, 20, "exciting")
    with Reader(path) as bag:
        offered = {one.topic: one.ext.offered_qos_profiles[0] for one in bag.connections}  # type: ignore[union-attr]
        assert {topic: qos.durability.name for topic, qos in offered.items()} == {
            "/robot_description": "TRANSIENT_LOCAL",
            **dict.fromkeys(
                ("/joint_states", "/joint_commands", "/joint_torques", "/joint_encoders", "/cycle", "/events"),
                "VOLATILE",
            ),
        }
        assert {qos.reliability.name for qos in offered.values()} == {"RELIABLE"}
        assert {qos.history.name for qos in offered.values()} == {"KEEP_LAST"}
        read: dict[str, list[object]] = {topic: [] for topic in offered}
        stamps = []
        for connection, stamp, payload in bag.messages():
            message = types.deserialize_cdr(payload, connection.msgtype)
            stamps.append(stamp)
            if hasattr(message, "header"):
                header = message.header
                assert header.stamp.sec * 10**9 + header.stamp.nanosec == stamp
                assert header.frame_id == ("" if connection.topic == "/cycle" else "base_link")
            read[connection.topic].append(message)
    assert stamps == sorted(stamps)
    assert {topic: len(found) for topic, found in read.items()} == {
        "/robot_description": 1,
        "/events": 1,
        "/joint_encoders": 0,
        **dict.fromkeys(("/joint_states", "/joint_commands", "/joint_torques", "/cycle"), count),
    }
    state, command = read["/joint_states"][-1], read["/joint_commands"][-1]
    assert state.name == list(names)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(state.effort, command.effort)  # type: ignore[attr-defined]
    # Behind a low-pass filter of 20 Hz, a slow motion's velocity is late by 8 ms.
    expected = 10.0 * np.cos(0.01 * (count - 1 - 8) + np.arange(7))
    np.testing.assert_allclose(state.velocity, expected, atol=0.1)  # type: ignore[attr-defined]
    assert read["/robot_description"][0].data == urdf  # type: ignore[attr-defined]
    assert [one.cycle for one in read["/cycle"]] == list(range(count))  # type: ignore[attr-defined]


LAYOUTS = Path(__file__).resolve().parents[2] / "configs" / "layouts"


@pytest.fixture(scope="module")
def fields(tmp_path_factory: pytest.TempPathFactory, types: Typestore, wam: ArmModel) -> dict[str, object]:
    """The last message of each topic of a recording of the WAM whose drives measure torques."""
    path = tmp_path_factory.mktemp("fields") / "run.mcap"
    with RecordingWriter(path, wam.chain.names, urdf_text(wam, None), OFFSET_NS) as writer:
        q = np.zeros(7)
        writer.sample(Cycle(START_NS, q, None, q, q, q, 0, 0, 0, q == 0, np.zeros(7, int), 0, q))
        writer.event(START_NS, 20, "armed")
    with Reader(path) as bag:
        return {one.topic: types.deserialize_cdr(data, one.msgtype) for one, _, data in bag.messages()}


def test_the_layout_for_foxglove_shows_what_recordings_have(fields: dict[str, object]) -> None:
    layout = json.loads((LAYOUTS / "foxglove.json").read_text())
    panels = layout["configById"]

    def placed(node: object) -> list[str]:
        return [node] if isinstance(node, str) else [*placed(node["first"]), *placed(node["second"])]  # type: ignore[index]

    assert sorted(placed(layout["layout"])) == sorted(panels)
    shown = set()
    for name, panel in panels.items():
        for series in panel.get("paths", ()):
            topic, field, index = re.fullmatch(r"(/\w+)\.(\w+)(?:\[(\d)\])?", series["value"]).groups()  # type: ignore[union-attr]
            value = getattr(fields[topic], field)
            assert np.isfinite(value if index is None else value[int(index)]), (name, series)
            shown.add(topic)
    urdf = panels["3D!arm"]["layers"]["urdf"]
    shown |= {urdf["topic"], panels["RosOut!events"]["topicToRender"]}
    assert urdf["layerId"] == "foxglove.Urdf"
    assert shown == set(fields)
    assert panels["3D!arm"]["followTf"] == fields["/joint_states"].header.frame_id  # type: ignore[attr-defined]


def test_the_layout_for_plotjuggler_shows_what_recordings_have(fields: dict[str, object]) -> None:
    # Its parser of joint states names series by the joints, that of all other messages by the fields.
    known = {
        f"{topic}/{joint}/{field}"
        for topic, message in fields.items()
        if topic.startswith("/joint_")
        for field in ("position", "velocity", "effort")
        if len(getattr(message, field))
        for joint in message.name  # type: ignore[attr-defined]
    }
    known |= {f"/cycle/{field}" for field in ("cycle", "lateness_ns", "compute_ns", "lost")}
    root = ET.fromstring((LAYOUTS / "plotjuggler.xml").read_text())  # noqa: S314 - our own
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert len(curves) == len(set(curves)) > 30
    assert set(curves) <= known
    assert {name.split("/")[1] for name in filter(None, curves)} == {
        *("joint_states", "joint_commands", "joint_torques", "cycle")
    }
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.get("count", "0")) == len(splitter) == len(splitter.get("sizes", "").split(";"))


def test_rosbag2_is_told_how_to_read_the_policies(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", 3)
    with path.open("rb") as stream:
        found = [one for one in make_reader(stream).iter_metadata() if one.name == "rosbag2"]
    assert [one.metadata for one in found] == [{"serialized_metadata": ""}]


@pytest.mark.parametrize("whole", [True, False])
def test_a_velocity_that_no_drive_reported_is_none_for_identification(tmp_path: Path, whole: bool) -> None:
    path = write_recording(tmp_path / "run.mcap", 500)
    if not whole:
        path.write_bytes(path.read_bytes()[:-2000])
    recording = McapRecording(path)
    assert recording.torn is not whole
    assert recording.metadata["velocity"] == DIFFERENCE
    assert read_all(recording).velocity is None
    told = McapRecording(write_recording(tmp_path / "told.mcap", 500, velocity=True))
    assert "velocity" not in told.metadata
    assert read_all(told).velocity is not None


def test_stamps_that_stand_still_make_no_velocity(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, JOINTS, "<robot/>", OFFSET_NS) as writer:
        for k in range(4):
            q = np.full(3, float(k))
            writer.sample(Cycle(START_NS, q, None, q, q, q, k, 0, 0, np.ones(3, bool), np.zeros(3, int), 0))
    with Reader(path) as bag:
        store = get_typestore(Stores.ROS2_HUMBLE)
        states = [one for one in bag.connections if one.topic == "/joint_states"]
        for _, _, payload in bag.messages(states):
            assert not np.any(store.deserialize_cdr(payload, states[0].msgtype).velocity)  # type: ignore[attr-defined]


def test_the_package_of_messages_is_what_recordings_hold() -> None:
    fields = [line for line in MESSAGE.read_text().splitlines() if line and not line.startswith("#")]
    assert "\n".join(fields) == DEFINITIONS[CYCLE].decode().split("=" * 80)[0].strip()
    package = ET.fromstring((PACKAGE / "package.xml").read_text())  # noqa: S314 - our own
    assert package.get("format") == "3"
    needed = {"name", "version", "description", "maintainer", "license", "member_of_group"}
    assert needed <= {element.tag for element in package}
    name = package.findtext("name")
    depends = {one.text for one in package.iter("depend")}
    build = (PACKAGE / "CMakeLists.txt").read_text()
    assert f"project({name})" in build
    assert f'"msg/{MESSAGE.name}" DEPENDENCIES {" ".join(sorted(filter(None, depends)))}' in build
    assert all(f"find_package({one} REQUIRED)" in build for one in depends)
    assert package.findtext("license") == "Apache-2.0"
    assert (PACKAGE / "LICENSE").read_bytes() == (PACKAGE.parents[1] / "LICENSE").read_bytes()


def test_viewers_see_each_body_where_the_collision_check_has_it(wam: ArmModel) -> None:
    text = urdf_text(wam, wam.prior, visible_bodies(wam))
    model = pin.buildModelFromXML(text)
    shapes = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.VISUAL)
    capsules = [body for body in link_bodies(wam) if isinstance(body.solid, Capsule)]
    found = {(one.parentJoint - 1, *np.round(one.placement.translation, 9)) for one in shapes.geometryObjects}
    for body in capsules:
        assert isinstance(body.solid, Capsule)
        for end in (body.solid.start, body.solid.end):
            assert (body.joint, *np.round(end, 9)) in found
    cylinders = [one for one in shapes.geometryObjects if isinstance(one.geometry, pin.coal.Cylinder)]
    for one, body in zip(
        sorted(cylinders, key=lambda one: one.parentJoint),
        sorted((b for b in capsules if np.any(b.solid.start != b.solid.end)), key=lambda b: b.joint),  # type: ignore[union-attr]
        strict=True,
    ):
        axis, (start, end) = one.placement.rotation[:, 2], (body.solid.start, body.solid.end)  # type: ignore[union-attr]
        np.testing.assert_allclose(axis, (end - start) / np.linalg.norm(end - start), atol=1e-9)
        assert one.geometry.halfLength == pytest.approx(0.5 * np.linalg.norm(end - start))


def test_an_arm_without_geometry_is_shown_as_sticks() -> None:
    model = arm_model(load_arm("planar2"))
    bare = model.config.model_copy(update={"geometry": {}})
    bodies = visible_bodies(arm_model(bare))
    assert {body.joint for body in bodies} >= set(range(model.chain.joints))


def test_the_frame_is_the_link_that_no_joint_carries() -> None:
    assert root_link(urdf_text(arm_model(load_arm("planar2")), None)) == "base_link"
    carried = '<joint><parent link="b"/><child link="a"/></joint>'
    assert root_link(f'<robot><link name="a"/><link name="b"/>{carried}</robot>') == "b"
    assert root_link("no XML") == root_link("<robot/>") == ""


def test_virtual_time_is_stamped_with_the_walls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    clock = VirtualClock(start_ns=7)
    stamp = clock.now_ns() + utc_offset_of_recording_ns(clock)
    assert abs(stamp - time.time_ns()) < 60e9
    assert utc_offset_of_recording_ns(VirtualClock(0, 5)) == 5
    real = RealClock()
    assert utc_offset_of_recording_ns(real) == real.utc_offset_ns
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    assert utc_offset_of_recording_ns(clock) + clock.now_ns() == 1_700_000_000 * 10**9
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "soon")
    with pytest.raises(UsageError, match="whole seconds"):
        utc_offset_of_recording_ns(clock)
