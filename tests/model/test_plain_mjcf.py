"""MJCFs are read as MuJoCo reads them: masses, places, gravity, limits; what is not is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exports.export_bench import mujoco_torque, needed
from helpers.random_arms import random_states

from ident_service.config.kinematics import Kinematics
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.chain import Chain
from ident_service.model.mechanism import Mechanism, read_mechanism
from ident_service.model.outline import mjcf_outline, read_source
from ident_service.model.parameter_layout import Layout
from ident_service.model.pinocchio_models import chain_of
from ident_service.model.plain_mjcf import mjcf_gravity, plain_mjcf
from ident_service.model.regressor import joint_regressor

SLIDE_AND_HINGE = """<mujoco>{head}<worldbody>
<body name="b"><joint name="x" type="slide" axis="1 0 0" range="0 1.5"{slide}/><geom type="sphere" size=".1" mass="1"/>
  <body name="c" pos="0 0 .2" euler="10 20 30"><joint name="y" axis="0 0 1" range="-90 90"{hinge}/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/></body></body></worldbody>{tail}</mujoco>"""
RADIAN = SLIDE_AND_HINGE.replace("10 20 30", "0.1 0.2 0.3").replace("-90 90", "-1.5 1.5")


def whole(text: str, head: str = "", slide: str = "", hinge: str = "", tail: str = "") -> str:
    return text.format(head=head, slide=slide, hinge=hinge, tail=tail)


CLASSES = """<mujoco><default><joint range="-1 1"/><geom density="500"/>
  <default class="s"><joint type="slide" axis="1 0 0" range="0 1.5" damping="2" armature=".3"/></default>
  <default class="h"><joint range="-90 90" axis="0 1 0"/><default class="i"><joint axis="1 0 0"/></default></default>
</default><worldbody><body name="b" childclass="s"><joint name="x"/><geom type="sphere" size=".1"/>
  <body name="c" pos="0 0 .2" axisangle="1 1 0 50"><joint name="y" class="h"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
    <body name="e" pos=".3 0 0" childclass="i"><joint name="z" pos="0 .1 0"/>
      <geom type="box" size=".03 .1 .2" pos="0 .1 0" euler="10 20 30"/></body></body></body></worldbody></mujoco>"""
UNLIMITED = """<mujoco><compiler autolimits="false"/><worldbody><body name="b">
  <joint name="x" type="slide" axis="1 0 0" range="0 1.5" limited="true"/><geom type="sphere" size=".1" mass="1"/>
  <body name="c" pos="0 0 .2"><joint name="y" axis="0 1 0" range="-90 90" limited="false"/>
    <geom type="sphere" size=".1" pos="0 .1 .1"/></body></body></worldbody></mujoco>"""
INERTIALS = """<mujoco><compiler {compiler}/><worldbody><body name="b" euler=".1 .2 .3"><joint name="x" axis="0 1 0"/>
  <inertial pos=".1 0 0" mass="5" diaginertia=".1 .1 .1"/>
  <geom type="cylinder" size=".1 .2" density="300" pos=".1 0 0"/>
  <frame pos=".1 .2 .3" euler="0 .5 .2"><geom type="sphere" size=".1" mass="3"/>
    <frame axisangle="0 1 0 .5"><body name="c" pos="0 0 .2"><joint name="y" axis="0 0 1"/>
      <geom type="ellipsoid" size=".1 .2 .3" pos=".1 0 0" mass="1"/></body></frame></frame></body>
</worldbody></mujoco>"""
SEVERAL = """<mujoco><compiler autolimits="true"/><compiler angle="radian"/>
<worldbody><geom type="plane" size="1 1 1"/><body name="table"><geom type="box" size=".1 .1 .1"/></body></worldbody>
<worldbody><body name="b" pos="0 0 .3"><joint name="x" axis="0 1 0" range="0 1.5"/>
  <geom type="sphere" size=".1" pos=".1 0 .2"/></body></worldbody></mujoco>"""
NAMELESS = """<mujoco><worldbody><body><joint name="x" axis="0 1 0"/><geom type="sphere" size=".1" pos=".1 0 0"/>
  <body pos="0 0 .3"><joint name="y" axis="0 1 0"/><geom type="sphere" size=".1" pos=".1 0 0"/>
    <body pos=".3 0 0"><geom type="sphere" size=".1"/></body></body></body></worldbody></mujoco>"""
READ = {
    "a slide in degrees": whole(SLIDE_AND_HINGE),
    "a slide in radians": whole(RADIAN, '<compiler angle="radian"/>'),
    "gravity": whole(SLIDE_AND_HINGE, '<option gravity="0 -9.81 0"/>'),
    "no gravity": whole(SLIDE_AND_HINGE, '<option><flag gravity="disable"/></option>'),
    "references in degrees": whole(SLIDE_AND_HINGE, "", ' ref=".2" springref=".3"', ' ref="20" armature=".1"'),
    "references in radians": whole(RADIAN, '<compiler angle="radian"/>', ' ref=".2"', ' ref=".4"'),
    "axes that do not turn": whole(RADIAN, '<compiler angle="radian" eulerseq="XZY"/>'),
    "axes in another order": whole(SLIDE_AND_HINGE, '<compiler eulerseq="zxy"/>'),
    "actuators": whole(
        SLIDE_AND_HINGE, "", "", "", '<actuator><motor joint="x" ctrlrange="-3 3" gear="10"/></actuator>'
    ),
    "classes": CLASSES,
    "ranges that do not limit": UNLIMITED,
    "frames and inertials": INERTIALS.format(compiler='angle="radian"'),
    "frames and geoms": INERTIALS.format(compiler='angle="radian" inertiafromgeom="true"'),
    "several bodies in the world": SEVERAL,
    "bodies without a name": NAMELESS,
}


def mechanism(text: str) -> Mechanism:
    return read_mechanism(TextFile(name="arm.xml", text=text), "mjcf")


def torques(read: Mechanism, states: tuple[np.ndarray, ...]) -> tuple[np.ndarray, Chain]:
    """Torques of what was read."""
    chain, bodies = chain_of(read, tuple(read.gravity))
    H = joint_regressor(chain, Layout(chain.revolute, ()), *states)
    return np.einsum("jps,p->sj", H, bodies.ravel()) + read.armature * states[2] + read.damping * states[1], chain


@pytest.mark.slow
@pytest.mark.parametrize("what", READ)
def test_what_mujoco_reads_is_read(what: str, tmp_path: Path) -> None:
    text, read = READ[what], mechanism(READ[what])
    states = random_states(np.random.default_rng(1), 8, len(read.names))
    found, chain = torques(read, states)
    expected, model = mujoco_torque(text, chain, states)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert read.names == tuple(model.joint(k).name for k in range(model.njnt))
    (tmp_path / "arm.xml").write_text(text)
    for name, limits in mjcf_outline(tmp_path / "arm.xml").limits.items():
        joint = model.joint(name)
        where = tuple(model.jnt_range[joint.id]) if model.jnt_limited[joint.id] else None
        assert limits.position == (where if where is None else pytest.approx(where, abs=1e-12))


@pytest.mark.slow
def test_a_slide_is_held_within_its_range_in_metres() -> None:
    file = TextFile(name="arm.xml", text=whole(SLIDE_AND_HINGE).replace("0 1.5", "0.4 1.5"))
    assert read_mechanism(file, "mjcf", Kinematics(mjcf=file, base="b")).held == {"x": 0.4}
    locked = Kinematics(mjcf=file, lock={"x": 0.5})
    assert read_mechanism(file, "mjcf", locked).translation[0].tolist() == pytest.approx([0.5, 0.0, 0.2])
    with pytest.raises(ModelError, match=r"x at 1\.6 is outside its limits, 0\.4 to 1\.5"):
        read_mechanism(file, "mjcf", Kinematics(mjcf=file, lock={"x": 1.6}))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("geom", "inertial", "compiler", "known"),
    [
        ("", "", "", False),
        (' mass="2"', "", "", False),
        (' mass="0"', "", "", True),
        (' density="0"', "", "", True),
        ("", '<inertial pos="0 0 .1" mass="3" diaginertia=".1 .1 .1"/>', "", True),
        ("", '<inertial pos="0 0 .1" mass="3" diaginertia=".1 .1 .1"/>', ' inertiafromgeom="true"', False),
    ],
)
def test_a_body_with_the_mass_of_a_mesh_has_none_that_is_known(
    geom: str, inertial: str, compiler: str, known: bool
) -> None:
    text = (
        f'<mujoco><compiler angle="radian"{compiler}/><asset><mesh name="m" file="m.stl"/></asset><worldbody>'
        f'<body name="a"><joint name="x"/>{inertial}<geom type="sphere" size=".1"/></body><body name="b">'
        f'<joint name="y"/><geom type="sphere" size=".1"/><body name="c">{inertial}<geom type="sphere" size=".1"/>'
        f'<geom type="mesh" mesh="m"{geom}/></body></body></worldbody></mujoco>'
    )
    first, second = mechanism(text).bodies
    assert first[9] > 0.0
    assert (second[9] > first[9]) if known else not second.any()


def test_ranges_of_slides_are_the_files_to_the_digit() -> None:
    assert 'range="0 1.5"' in plain_mjcf(whole(SLIDE_AND_HINGE))


@pytest.mark.slow
def test_gravity_is_seen_from_the_base() -> None:
    head = '<option gravity="0 -9 0"/><option gravity="0 0 -9"/>'
    file = TextFile(name="arm.xml", text=whole(SLIDE_AND_HINGE, head).replace("10 20 30", "90 0 0"))
    read = read_mechanism(file, "mjcf", Kinematics(mjcf=file, tip="b"))
    assert read.gravity.tolist() == [0.0, 0.0, -9.0]
    read = read_mechanism(file, "mjcf", Kinematics(mjcf=file, base="b"))
    assert read.gravity.tolist() == [0.0, 0.0, -9.0]
    more = file.text.replace("</body></body>", '<body name="d"><joint name="z"/><geom size=".1"/></body></body></body>')
    file = TextFile(name="arm.xml", text=more)
    read = read_mechanism(file, "mjcf", Kinematics(mjcf=file, base="c"))
    assert read.gravity.tolist() == pytest.approx([0.0, -9.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("words", ["0 -9.81", "a b c", "0 0 nan"])
def test_a_gravity_that_is_none_is_refused(words: str) -> None:
    with pytest.raises(ModelError, match=f"option gravity is '{words}'; give three numbers"):
        mjcf_gravity(f'<mujoco><option gravity="{words}"/></mujoco>')


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (whole(SLIDE_AND_HINGE, '<compiler settotalmass="7"/>'), "compiler settotalmass='7' is not supported; give"),
        (whole(SLIDE_AND_HINGE, '<compiler boundmass="0.1"/>'), "boundmass='0.1' is not supported"),
        (whole(SLIDE_AND_HINGE, '<compiler boundinertia="0.1"/>'), "boundinertia='0.1' is not supported"),
        (whole(SLIDE_AND_HINGE, '<compiler inertiagrouprange="0 1"/>'), "inertiagrouprange='0 1' is not supported"),
        (whole(SLIDE_AND_HINGE, '<compiler balanceinertia="true"/>'), "balanceinertia='true' is not supported"),
        (whole(SLIDE_AND_HINGE, '<compiler coordinate="global"/>'), "coordinate='global' is not supported"),
        (whole(SLIDE_AND_HINGE, '<compiler eulerseq="xYz"/>'), "eulerseq='xYz': axes that turn and axes that do not"),
        (whole(SLIDE_AND_HINGE, "", ' class="none"'), "joint 'x': no default has the class 'none'"),
        (SEVERAL.replace("<body name=", '<replicate count="2"/><body name=', 1), "<replicate> is not supported"),
    ],
)
def test_what_would_be_another_arm_is_refused(text: str, words: str) -> None:
    with pytest.raises(ModelError) as caught:
        plain_mjcf(text)
    assert words in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "refused", ['boundmass="0.5"', 'boundinertia="0.5"', 'inertiagrouprange="0 1"', 'eulerseq="xYz"']
)
def test_what_mujoco_saves_of_a_refused_file_is_read(refused: str, tmp_path: Path) -> None:
    """The remedy that a refusal names."""
    mujoco = needed("mujoco")
    text = whole(RADIAN, f'<compiler angle="radian" saveinertial="true" {refused}/>')
    text = text.replace("<geom", '<geom group="2" type="box" size=".1 .1 .3"/><geom', 1)
    before = mujoco.MjModel.from_xml_string(text)
    mujoco.mj_saveLastXML(str(tmp_path / "saved.xml"), before)
    saved = (tmp_path / "saved.xml").read_text().replace(refused, "")
    read = mechanism(saved)
    states = random_states(np.random.default_rng(1), 8, len(read.names))
    found, chain = torques(read, states)
    np.testing.assert_allclose(found, mujoco_torque(text, chain, states)[0], rtol=1e-3, atol=1e-3)  # of few digits


@pytest.mark.slow
def test_a_refusal_names_the_file(tmp_path: Path) -> None:
    text = whole(SLIDE_AND_HINGE, '<compiler settotalmass="7"/>')
    (tmp_path / "arm.xml").write_text(text)
    for read in (lambda: mechanism(text), lambda: read_source(tmp_path / "arm.xml")):
        with pytest.raises(ModelError, match=r"^arm\.xml: compiler settotalmass='7' is not supported"):
            read()


@pytest.mark.parametrize("harmless", ['settotalmass="-1"', 'boundmass="0"', 'inertiagrouprange="0 5"'])
def test_the_defaults_of_the_compiler_may_be_written_out(harmless: str) -> None:
    assert harmless in plain_mjcf(whole(SLIDE_AND_HINGE, f"<compiler {harmless}/>"))
