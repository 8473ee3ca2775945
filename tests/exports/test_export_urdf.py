"""URDF: what is not inertia or friction stays byte for byte, bodies are real, and pinocchio has the same torques."""

from __future__ import annotations

import difflib
import re
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from exports.export_bench import (
    SIMULATED,
    arm_of_file,
    assert_same,
    identified,
    pinocchio_torque,
    some_delta,
    states_of,
    torque_of,
    true_arm,
)
from helpers.random_arms import bodies_of, model_around, random_body, random_chain, random_delta
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.load import load_arm
from ident_service.errors import IdentError, ModelError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.urdf import urdf_text
from ident_service.results.export import urdf as urdf_file
from ident_service.results.export.bodies import in_other_frame, is_real
from ident_service.results.export.identified_arm import IdentifiedArm
from ident_service.results.export.round_trip import supported_terms
from ident_service.results.export.urdf import original_urdf, parse_xml_with_places, urdf_export

Array = np.ndarray

FOREIGN = """<?xml version='1.0' encoding="utf-8"?>
<!-- A hand-written file: <inertial> in a comment is not one, nor is a "> in it. -->
<robot   name='foreign'
         xmlns:xacro="http://www.ros.org/wiki/xacro">
\t<material name="blue"><color rgba="0 0 1 1"/></material>
  <link name='world_fixed'/>
  <link name="base">
    <inertial><mass value="7"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="arm &lt;1&gt; 'a' &quot;b&quot;" note="x > y">
    <!-- before -->
    <inertial>
      <!-- weighed on a Tuesday -->
      <inertia izz="0.03" ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" unit='kg m2'/>
      <mass   value = "2" />
      <origin rpy="0.1 0.2 0.3" xyz="0.1 0 0"/>
      <!-- weighed on a Wednesday -->
    </inertial>
    <visual>
      <geometry><mesh filename="package://foreign/µ.stl" scale="1 1 1"/></geometry>
      <material name="blue"/>
    </visual>
    <collision><geometry><cylinder length="0.1" radius="0.02"/></geometry></collision>
  </link>
  <link name="tool"><inertial><origin xyz="0 0 0.1"/><mass value="0.3"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
  <link name="camera">
    <inertial>
      <mass value="0.1"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/>
    </inertial>
  </link>
  <link name="frame"/>
  <link name="last" />
  <joint name="foot" type="fixed"><parent link="world_fixed"/><child link="base"/>
    <origin xyz="0 0 0.3" rpy="0.1 0 0"/></joint>
  <joint type="revolute" name="one">
    <child link="arm &lt;1&gt; 'a' &quot;b&quot;"/><parent link="base"/>
    <origin xyz="0 0 0.2" rpy="0 0.4 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="3" effort="40"/>
    <dynamics friction="9" comment='old' damping="8"/>
    <safety_controller k_velocity="10"/>
  </joint>
  <joint name="flange" type="fixed"><parent link="arm &lt;1&gt; 'a' &quot;b&quot;"/><child link="tool"/>
    <origin xyz="0 0 0.3" rpy="0 0 0.5"/></joint>
  <joint name="bracket" type="fixed"><parent link="tool"/><child link="camera"/>
    <origin xyz="0.05 0 0" rpy="0.2 0 0"/></joint>
  <joint name="dot" type="fixed"><parent link="tool"/><child link="frame"/></joint>
  <joint name="two" type="continuous"><parent link="frame"/><child link="last"/><axis xyz="0 0 1"/></joint>
  <transmission name="t1"><joint name="one">
    <hardwareInterface>EffortJointInterface</hardwareInterface></joint></transmission>
  <gazebo reference="tool"><inertial><mass value="1"/></inertial><dynamics damping="1"/></gazebo>
  <ros2_control name="rc" type="system"><joint name="two"><command_interface name="effort"/></joint></ros2_control>
</robot>
<!-- after the end -->
"""
WITHOUT = re.compile(
    r"""<(?:mass|inertia|origin|dynamics)\b[^>]*>|\s*<inertial>|\s*</inertial>|\s*<!-- its inertia[^>]*-->"""
)


def foreign(tmp_path: Path, text: str = FOREIGN) -> ArmModel:
    return arm_of_file(tmp_path, "urdf", text)


def weights(model: ArmModel, seed: int = 1) -> Array:
    """Parameters of a heavy first body, of which the tool and the camera may well be parts."""
    delta = some_delta(model, seed)
    cloud = sum(random_body(np.random.default_rng(k)) for k in range(8))
    delta[model.layout.inertial(0)] = cloud + parts(model.config.kinematics.urdf.text)  # type: ignore[union-attr]
    return delta


def parts(text: str) -> Array:
    """Tool and camera of the foreign file seen from the arm, merged by pinocchio."""
    light = re.sub(r'<mass   value = "2" />', '<mass value="0"/>', text)
    light = light.replace('izz="0.03" ixx="0.03" ixy="0" ixz="0" iyy="0.03"', 'izz="0" ixx="0" ixy="0" ixz="0" iyy="0"')
    m, *rest = pin.buildModelFromXML(light).inertias[1].toDynamicParameters()
    mx, my, mz, xx, xy, yy, xz, yz, zz = rest
    return np.array([xx, xy, xz, yy, yz, zz, mx, my, mz, m])


def written(model: ArmModel, delta: Array) -> tuple[str, tuple[str, ...]]:
    text, _, notes = urdf_export(model, delta, "arm.urdf")
    return text, notes


def torque_in_pinocchio(arm: IdentifiedArm, text: str) -> Array:
    return pinocchio_torque(pin.buildModelFromXML(text), arm.model.chain, states_of(arm.model.chain))


def link_bodies(text: str) -> dict[str, Array]:
    """Each link's own ten parameters, read by pinocchio from a file in which every link moves by itself."""
    root = parse_xml_with_places(text, "x")
    bodies = {}
    for link in root.all("link"):
        if link.first("inertial") is None:
            continue
        own = text.encode()[link.start : link.end].decode()
        name = re.search(r"name=('[^']*'|\"[^\"]*\")", own).group(1)  # type: ignore[union-attr]
        joint = f'<joint name="j" type="continuous"><parent link="_"/><child link={name}/><axis xyz="0 0 1"/></joint>'
        model = pin.buildModelFromXML(f'<robot name="r"><link name="_"/>{own}{joint}</robot>')
        m, mx, my, mz, xx, xy, yy, xz, yz, zz = model.inertias[1].toDynamicParameters()
        bodies[link.attributes["name"]] = np.array([xx, xy, xz, yy, yz, zz, mx, my, mz, m])
    return bodies


@pytest.mark.parametrize("name", SIMULATED)
def test_pinocchio_has_the_regressor_s_torques(name: str) -> None:
    arm = true_arm(name)
    assert arm.delta is not None
    text, _ = written(arm.model, arm.delta)
    assert_same(torque_in_pinocchio(arm, text), torque_of(arm, states_of(arm.model.chain), ()))
    read = pin.buildModelFromXML(text)
    places = [read.joints[read.getJointId(joint)].idx_v for joint in arm.model.chain.names]
    np.testing.assert_array_equal(read.damping[places], arm.model.layout.term_values("viscous", arm.delta))
    coulomb = arm.model.layout.term_values("coulomb", arm.delta)
    np.testing.assert_array_equal(read.upperDryFrictionLimit[places], coulomb)


@pytest.mark.parametrize("name", ["threelink", "tx40", "kuka_lwr4", "ur10"])
def test_the_shipped_files_keep_everything_else(name: str) -> None:
    model = arm_model(load_arm(name))
    arm = identified(model, some_delta(model))
    text, _ = written(model, some_delta(model))
    assert_same(torque_in_pinocchio(arm, text), torque_of(arm, states_of(model.chain), ()))
    original = model.config.kinematics.urdf.text  # type: ignore[union-attr]
    assert skeleton(text) == skeleton(original)


def test_of_a_file_with_rounded_angles_these_are_exact_and_nothing_else_changes(tmp_path: Path) -> None:
    rounded = FOREIGN.replace('rpy="0 0.4 0"', 'rpy="1.5708  -0.2 0"')
    assert rounded != FOREIGN
    arm_of_file(tmp_path, "urdf", rounded)
    description = tmp_path / "arm.yaml"
    description.write_text(description.read_text().replace("urdf: arm.urdf", "urdf: arm.urdf, snap: true"))
    model = arm_model(load_arm(description))
    delta = weights(model)
    text, notes = written(model, delta)
    assert 'rpy="1.5707963267948966 -0.2 0.0"' in text
    assert "rpy: angles that kinematics.snap takes as exact have all digits, as in the model" in notes
    without = re.compile('rpy="[^"]*"')
    assert without.sub("", skeleton(text)) == without.sub("", skeleton(rounded))
    assert not any(one.startswith("rpy") for one in written(foreign(tmp_path), delta)[1])


def tag(line: str) -> str:
    found = re.match(r"[-+]\s*<(/?\w+)", line)
    assert found is not None, line
    return found.group(1)


def skeleton(text: str) -> str:
    """A file without inertias and friction, and without the way in which empty elements are written."""
    bare = re.sub(WITHOUT, "", text)
    bare = re.sub(r"<link ([^<>]*[^/<> ])\s*/>", r"<link \1></link>", bare)
    return re.sub(r"\s+", "", bare)


def test_a_foreign_file_changes_in_inertias_and_friction_only(tmp_path: Path) -> None:
    model = foreign(tmp_path)
    delta = weights(model)
    text, notes = written(model, delta)
    arm = identified(model, delta)
    assert_same(torque_in_pinocchio(arm, text), torque_of(arm, states_of(model.chain), ()))
    said = "has the identified body less the links fixed to it, which are unchanged: tool, camera"
    assert notes == (f"""link arm <1> 'a' "b" {said}""",)
    # Line by line, in the order of the file, only these differ.
    differences = list(difflib.ndiff(FOREIGN.splitlines(), text.splitlines()))
    removed, added = ([tag(line) for line in differences if line.startswith(sign)] for sign in ("- ", "+ "))
    assert removed == ["inertia", "mass", "origin", "link", "dynamics", "joint"]
    body = ["link", "inertial", "origin", "mass", "inertia", "/inertial", "/link"]
    assert added == ["inertia", "mass", "origin", *body, "dynamics", "joint", "dynamics", "/joint"]
    # Attributes keep their order, and those that are nobody's stay.
    n = '"[^"]+"'
    assert re.search(f'<inertia izz={n} ixx={n} ixy={n} ixz={n} iyy={n} iyz={n} unit="kg m2"/>', text)
    assert re.search(r"""<dynamics friction="[^"]+" comment="old" damping="[^"]+"/>""", text)
    for kept in ("weighed on a Tuesday", "weighed on a Wednesday", "<!-- after the end -->", "package://foreign/µ.stl"):
        assert kept in text
    assert re.search(r"<transmission.*</ros2_control>", FOREIGN, re.DOTALL).group(0) in text  # type: ignore[union-attr]


def test_every_link_is_a_real_body_and_their_sum_is_the_identified_one(tmp_path: Path) -> None:
    model = foreign(tmp_path)
    text, _ = written(model, weights(model))
    bodies = link_bodies(text)
    before = link_bodies(FOREIGN)
    assert set(bodies) == {*before, "last"}
    for kept in ("base", "tool", "camera"):
        np.testing.assert_array_equal(bodies[kept], before[kept])
    assert all(is_real(body) for body in bodies.values())


def test_bolted_links_give_their_inertia_up_where_the_rest_would_be_no_body(tmp_path: Path) -> None:
    model = foreign(tmp_path)
    delta = some_delta(model)
    light = delta[model.layout.inertial(0)]
    light *= 0.2 / light[9]  # lighter than the tool
    text, notes = written(model, delta)
    arm = identified(model, delta)
    assert_same(torque_in_pinocchio(arm, text), torque_of(arm, states_of(model.chain), ()))
    assert "has the whole identified body; links fixed to it have no inertia now: tool, camera" in notes[0]
    bodies = link_bodies(text)
    assert set(bodies) == {"base", """arm <1> 'a' "b\"""", "last"}
    assert all(is_real(body) for body in bodies.values())
    assert text.count("its inertia is part of the link that it is fixed to") == 2
    assert skeleton(text) == skeleton(FOREIGN)


def test_a_bolted_link_that_is_no_body_itself_does_not_stay(tmp_path: Path) -> None:
    text = FOREIGN.replace('<mass value="0.1"/><inertia ixx="1e-4"', '<mass value="0.1"/><inertia ixx="1.0"')
    model = foreign(tmp_path, text)
    written_text, notes = written(model, weights(model))
    assert "the whole identified body" in notes[0]
    assert all(is_real(body) for body in link_bodies(written_text).values())


def test_a_bolted_link_of_nothing_stays_as_it_is(tmp_path: Path) -> None:
    zero = '<link name="frame"><inertial><mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'
    text = FOREIGN.replace('<link name="frame"/>', f"{zero}</inertial></link>")
    model = foreign(tmp_path, text)
    found, notes = written(model, weights(model))
    assert notes[0].endswith("are unchanged: tool, camera")
    assert zero in found


def test_exporting_twice_changes_nothing_more(tmp_path: Path) -> None:
    model = foreign(tmp_path)
    delta = weights(model)
    once, _ = written(model, delta)
    twice, _ = written(foreign(tmp_path, once), delta)
    for first, second in zip(once.splitlines(), twice.splitlines(), strict=True):
        if first != second:  # the rest of a body is computed anew
            numbers = [np.array([float(n) for n in re.findall(r"-?\d+\.[\de+-]+", line)]) for line in (first, second)]
            np.testing.assert_allclose(numbers[0], numbers[1], rtol=1e-9, atol=1e-12)


def test_friction_that_the_model_lacks_stays_as_it_was(tmp_path: Path) -> None:
    model = arm_of_file(tmp_path, "urdf", FOREIGN, terms="[drive_inertia, viscous]")
    text, notes = written(model, weights(model))
    assert "joint one has the friction of the original file" in notes
    found = re.search(r"<dynamics friction=\"9\" comment=\"old\" damping=\"([^\"]+)\"/>", text)
    assert found is not None
    assert float(found.group(1)) == model.layout.term_values("viscous", weights(model))[0]


def test_no_dynamics_are_made_up(tmp_path: Path) -> None:
    model = arm_of_file(tmp_path, "urdf", FOREIGN, terms="[]")
    text, _ = written(model, weights(model))
    assert text.count("<dynamics") == FOREIGN.count("<dynamics")
    assert """<dynamics friction="9" comment='old' damping="8"/>""" in text


@pytest.mark.slow
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6), square=st.booleans())
def test_random_files_take_other_bodies(seed: int, joints: int, square: bool) -> None:
    rng = np.random.default_rng(seed)
    first = model_around(random_chain(rng, joints, square=square))
    text = urdf_text(first, random_delta(rng, first.layout) if seed % 2 else None)
    with tempfile.TemporaryDirectory() as folder:
        model = arm_of_file(Path(folder), "urdf", text)
    arm = identified(model, random_delta(rng, model.layout))
    assert arm.delta is not None
    new, _ = written(model, arm.delta)
    assert_same(torque_in_pinocchio(arm, new), torque_of(arm, states_of(model.chain), ()))
    assert skeleton(new) == skeleton(text)


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_elements_are_found_at_their_places_in_the_text(mark: str) -> None:
    """Cut out of the text by their places, against Python's own tree."""
    data = (mark + FOREIGN).encode()
    pairs = [(parse_xml_with_places(mark + FOREIGN, "arm.urdf"), ET.fromstring(FOREIGN.encode()))]  # noqa: S314  # ours
    count = 0
    while pairs:
        found, meant = pairs.pop()
        cut = data[found.start : found.end].decode()
        own = {key: value for key, value in found.attributes.items() if not key.startswith("xmlns")}
        assert (found.tag, own) == (meant.tag, meant.attrib)
        assert cut.startswith(f"<{found.tag}")
        assert cut.endswith("/>" if found.head == found.end else f"</{found.tag}>")
        assert data[found.head - 1 : found.head] == b">"
        pairs += zip(found.children, meant, strict=True)
        count += 1
    assert count == FOREIGN.count("</") + FOREIGN.count("/>")


HOSTILE = {
    "entity": ("<robot ", '<!DOCTYPE robot [<!ENTITY a "aaaa">]>\n<robot '),
    "external": ("<robot ", '<!DOCTYPE robot SYSTEM "file:///etc/passwd">\n<robot '),
    "bomb": ("<robot ", '<!DOCTYPE r [<!ENTITY a "a"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n<robot '),
    "include": ("<material", '<include href="/etc/passwd"/><material'),
    "unclosed": ("</robot>", ""),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_refused(tmp_path: Path, kind: str) -> None:
    old, new = HOSTILE[kind]
    text = re.sub(r"<robot\s+", "<robot ", FOREIGN)
    assert old in text
    with pytest.raises(IdentError):
        foreign(tmp_path, text.replace(old, new, 1))


@pytest.mark.parametrize("kind", ["entity", "external", "bomb", "unclosed"])
def test_the_editor_refuses_them_too(kind: str) -> None:
    old, new = HOSTILE[kind]
    with pytest.raises(ModelError, match=r"arm\.urdf: (a document type or entities are refused|not XML)"):
        parse_xml_with_places(re.sub(r"<robot\s+", "<robot ", FOREIGN).replace(old, new, 1), "arm.urdf")


def test_the_editor_refuses_bottomless_files() -> None:
    with pytest.raises(ModelError, match="more than 200 elements in one another"):
        parse_xml_with_places("<a>" * 300 + "</a>" * 300, "arm.urdf")


def test_a_link_without_mass_is_refused(tmp_path: Path) -> None:
    model = foreign(tmp_path)
    with pytest.raises(ModelError, match="mass 0 kg"):
        urdf_export(model, np.zeros(model.layout.size), "arm.urdf")


def test_an_edit_that_goes_wrong_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = foreign(tmp_path)

    def careless(*arguments: object) -> tuple[str, tuple[str, ...]]:
        text, notes = original_urdf(*arguments)  # type: ignore[arg-type]
        return text.replace('<mass value="', '<mass value="1', 1), notes

    monkeypatch.setattr(urdf_file, "original_urdf", careless)
    light = re.sub(r'name="base">\s*<inertial>.*?</inertial>', 'name="base">', FOREIGN)
    model = foreign(tmp_path, light)
    with pytest.raises(ModelError, match=r"torques are up to .* apart; it was not written"):
        urdf_export(model, weights(model), "arm.urdf")


def test_bodies_move_as_pinocchio_moves_them() -> None:
    rng = np.random.default_rng(2)
    body, rotation, translation = random_body(rng), pin.rpy.rpyToMatrix(*rng.normal(size=3)), rng.normal(size=3)
    xx, xy, xz, yy, yz, zz, x, y, z, m = body
    inertia = pin.Inertia.FromDynamicParameters(np.array([m, x, y, z, xx, xy, yy, xz, yz, zz]))
    there = inertia.se3Action(pin.SE3(rotation, translation)).toDynamicParameters()
    np.testing.assert_allclose(
        in_other_frame(body, rotation, translation)[[9, 6, 7, 8, 0, 1, 3, 2, 4, 5]], there, atol=1e-12
    )


def test_what_is_no_body_is_distinguished_from_what_is() -> None:
    body = random_body(np.random.default_rng(3))
    assert is_real(body)
    assert is_real(in_other_frame(body, np.eye(3), np.array([100.0, 0.0, 0.0])))
    heavy = body.copy()
    heavy[0] += 10.0  # no triangle
    assert not is_real(heavy)
    assert not is_real(np.zeros(10))
    assert not is_real(-body)


def test_shared_drives_carry_nothing(tmp_path: Path) -> None:
    model = arm_model(load_arm("tx40"))
    has = supported_terms(model, some_delta(model), ("viscous", "coulomb"))
    np.testing.assert_array_equal(has["viscous"], [True] * 4 + [False] * 2)
    assert bodies_of(model.layout, some_delta(model)).shape == (6, 10)


def test_comments_stand_at_the_end_and_once(tmp_path: Path) -> None:
    source = (Path(__file__).parents[2] / "configs" / "threelink.urdf").read_text()
    model = arm_of_file(tmp_path, "urdf", source)
    delta = some_delta(model)
    bare, said = urdf_export(model, delta, "a.urdf")[0], ("one -- of many", "<two>")
    text = urdf_export(model, delta, "a.urdf", said)[0]
    assert text == bare + "<!-- ident-service: one - of many. -->\n<!-- ident-service: _two_. -->\n"
    again = arm_of_file(tmp_path, "urdf", text)
    assert urdf_export(again, delta, "a.urdf", said)[0] == text
    assert urdf_export(again, delta, "a.urdf")[0] == bare
