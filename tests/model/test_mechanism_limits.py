"""Files that break the parsers in C++, or would: each is one clear error, and the process lives."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.forks import fork
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.limited_process import run_limited_process
from ident_service.model.mechanism import DEEPEST_LINKS, MOST_LINKS, Kind, read_mechanism

LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'


def urdf(*parts: str) -> str:
    return f'<robot name="r">{"".join(parts)}</robot>'


def links(count: int) -> str:
    return "".join(f'<link name="l{k}"/>' for k in range(count))


def joint(number: int, parent: int, child: int, kind: str = "revolute") -> str:
    ends = f'<parent link="l{parent}"/><child link="l{child}"/>'
    return f'<joint name="j{number}" type="{kind}">{ends}<axis xyz="0 0 1"/>{LIMIT}</joint>'


def chain(count: int, kind: str = "revolute") -> str:
    return urdf(links(count), *(joint(k, k - 1, k, kind) for k in range(1, count)))


def nested(count: int) -> str:
    return f"<mujoco><worldbody>{'<body>' * count}{'</body>' * count}</worldbody></mujoco>"


INERTIAL = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>'
ARM = (
    '<mujoco><compiler angle="radian"/><worldbody>'
    f'<body name="one"><joint name="turn" axis="0 1 0" range="-1 1" damping="1"/>{INERTIAL}'
    f'<body name="two" pos="0 0 1"><joint name="slide" type="slide" axis="1 0 0" armature="2"/>{INERTIAL}</body></body>'
    '</worldbody><keyframe><key name="k" qpos="0 0" qvel="0 0"/></keyframe></mujoco>'
)


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        pytest.param("mjcf", nested(100_000), "more than 64 links in one another", id="100,000 bodies in one another"),
        pytest.param("urdf", chain(5_000), "more than 256 links", id="5,000 links"),
        pytest.param("urdf", chain(5_000, "fixed"), "more than 256 links", id="5,000 fixed links"),
        pytest.param("urdf", chain(DEEPEST_LINKS + 1), "more than 64 links in one another", id="links in one another"),
        pytest.param(
            "urdf",
            urdf(links(3), joint(1, 0, 1), joint(2, 1, 2), joint(3, 2, 1)),
            "'l1' is the child of two joints",
            id="circle that the base reaches",
        ),
        pytest.param(
            "urdf", urdf(links(4), joint(1, 0, 1), joint(2, 2, 3), joint(3, 3, 2)), "in a circle", id="circle apart"
        ),
        pytest.param("urdf", urdf("<a>" * 100_000 + "</a>" * 100_000), "elements in one another", id="deep elements"),
        pytest.param("mjcf", "<mujoco>" + "<geom/>" * 30_000 + "</mujoco>", "more than 20000 elements", id="elements"),
        pytest.param("urdf", urdf(" " * 2**21), "larger than", id="bytes"),
        pytest.param("mjcf", "<mujoco>", "not a MJCF that can be read", id="no end"),
        # With this, pinocchio 3 writes beyond its memory; the daemon that read it died.
        pytest.param(
            "mjcf",
            ARM.replace('"slide"', '"universe"', 1).replace('qpos="0 0" ', ""),
            "breaks what reads it",
            id="heap",
        ),
    ],
)
def test_a_file_beyond_the_limits_is_one_clear_error(kind: Kind, text: str, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        read_mechanism(TextFile(name="arm.xml", text=text), kind)
    assert str(caught.value).startswith("arm.xml: ")
    assert len(str(caught.value)) < 600


@pytest.mark.slow
def test_the_largest_that_may_be_read_is_read() -> None:
    assert len(read_mechanism(TextFile(name="a.urdf", text=chain(DEEPEST_LINKS)), "urdf").names) == DEEPEST_LINKS - 1
    star = urdf(links(MOST_LINKS), *(joint(k, 0, k) for k in range(1, MOST_LINKS)))
    assert len(read_mechanism(TextFile(name="a.urdf", text=star), "urdf").names) == MOST_LINKS - 1
    body = "".join(f'<body name="b{k}"><joint name="j{k}" axis="0 0 1"/>{INERTIAL}' for k in range(DEEPEST_LINKS))
    text = f"<mujoco><worldbody>{body}{'</body>' * DEEPEST_LINKS}</worldbody></mujoco>"
    assert len(read_mechanism(TextFile(name="a.xml", text=text), "mjcf").names) == DEEPEST_LINKS


def test_the_deepest_urdf_needs_an_eighth_of_the_smallest_stack() -> None:
    words = (
        "from types import SimpleNamespace; from ident_service.model.mechanism_process import urdf_document\n"
        f"print(len(urdf_document(SimpleNamespace(text={chain(64)!r}), None)['names']))"
    )
    limited = f'ulimit -s 256; exec {sys.executable} -c "$0"'
    done = subprocess.run(["bash", "-c", limited, words], capture_output=True, text=True, timeout=60)
    assert done.stdout == "63\n", done.stderr


def test_an_mjcf_is_read_in_another_process() -> None:
    found = read_mechanism(TextFile(name="arm.xml", text=ARM), "mjcf")
    assert (found.names, found.damping.tolist(), found.armature.tolist()) == (("turn", "slide"), [1, 0], [0, 2])
    assert {name: joint for name, (joint, *_) in found.frames.items()} == {"one": 0, "two": 1}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("work", "deadline", "message"),
    [
        pytest.param("while True: pass", 30.0, "takes too long to read and judge", id="computes without an end"),
        pytest.param("import time; time.sleep(60)", 0.5, "within 0.5 s", id="waits without an end"),
        pytest.param("x = bytearray(2**30)", 30.0, "too much memory", id="memory"),
        pytest.param("import os; os.abort()", 30.0, "breaks what reads it", id="abort"),
        pytest.param("print('noise')", 30.0, None, id="good"),
    ],
)
def test_a_process_ends_at_its_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, work: str, deadline: float, message: str | None
) -> None:
    (tmp_path / "limited_work.py").write_text(
        "from ident_service.model.limited_process import print_json_within_limits\n"
        f"def work():\n    {work}\n    return {{'done': True}}\n"
        "print_json_within_limits(2**29, 1, work)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    if message is None:
        assert run_limited_process("limited_work", tmp_path, deadline) == {"done": True}
        return
    with pytest.raises(ModelError, match=message):
        run_limited_process("limited_work", tmp_path, deadline)


BITS = [
    "",
    "0",
    "-1",
    "nan",
    "inf",
    "1e308",
    "0 0 0",
    "1 2",
    "l0",
    "l1",
    "l2",
    "universe",
    "revolute",
    "floating",
    "mesh",
]
BASE = urdf(
    '<material name="g"><color rgba="1 0 0 1"/></material>',
    '<link name="l0"><visual><origin xyz="0 0 0" rpy="0 0 0"/><geometry><box size="1 1 1"/></geometry>'
    '<material name="g"/></visual></link>',
    '<link name="l1"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    '<collision><geometry><mesh filename="a.stl" scale="1 1 1"/></geometry></collision></link><link name="l2"/>',
    joint(1, 0, 1).replace("</joint>", '<dynamics damping="1" friction="2"/><calibration rising="1"/></joint>'),
    joint(2, 1, 2, "prismatic"),
)
_PIECES = BASE.replace(">", ">\n").replace('="', '="\n').split("\n")


@st.composite
def spoiled_urdfs(draw: Callable[..., int]) -> str:
    pieces = list(_PIECES)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(pieces) - 1))
        what = draw(st.integers(0, 3))
        if what == 0:
            del pieces[at]
        elif what == 1:
            pieces.insert(at, pieces[draw(st.integers(0, len(pieces) - 1))])
        elif what == 2 and '"' in pieces[at]:
            pieces[at] = BITS[draw(st.integers(0, len(BITS) - 1))] + pieces[at][pieces[at].index('"') :]
        else:
            pieces[at] = pieces[at][: draw(st.integers(0, len(pieces[at])))]
    return "".join(pieces)


def no_crash(text: str) -> None:
    """Read it in a fork of this process: read, or one error, and the fork lives."""
    child = fork()
    if child == 0:
        code = 1
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            read_mechanism(TextFile(name="a.urdf", text=text), "urdf")
            code = 0
        except ModelError:
            code = 0
        finally:
            os._exit(code)
    assert os.waitpid(child, 0)[1] == 0, text


@pytest.mark.slow
@given(spoiled_urdfs())
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_no_small_urdf_breaks_its_parser(text: str) -> None:
    no_crash(text)


@pytest.mark.campaign
@given(spoiled_urdfs())
@settings(max_examples=3000, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_no_urdf_of_very_many_breaks_its_parser(text: str) -> None:
    no_crash(text)
