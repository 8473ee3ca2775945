"""Descriptions that would break, or occupy, whoever reads them: each is one clear error, and the daemon goes on."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from daemon.conftest import Asked
from daemon.served import daemon_process
from helpers.forks import start_processes

from ident_service.daemon.routes.checks import MOST_CHECKS
from ident_service.errors import ConfigError, ModelError
from ident_service.operations.description_process import _require_own_meshes
from ident_service.registry.arms import add_arm

ARM = "format: ident-arm\nversion: 1\nname: spy\nkinematics: {{{kind}: arm.xml}}\n"
INERTIAL = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>'


@pytest.fixture(autouse=True)
def started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start interpreters: limits of memory are for one of its own, and a daemon is to have loaded nothing yet."""
    start_processes(monkeypatch)


def body(kind: str, text: str) -> dict[str, object]:
    return {"description": ARM.format(kind=kind), "files": {"arm.xml": text}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        pytest.param(
            "mjcf",
            f"<mujoco><worldbody>{'<body>' * 100_000}{'</body>' * 100_000}</worldbody></mujoco>",
            "arm.xml: more than 64 links in one another",
            id="100,000 bodies in one another",
        ),
        pytest.param(
            "urdf",
            "<robot name='r'>"
            + "".join(f'<link name="l{k}"/>' for k in range(5_000))
            + "".join(
                f'<joint name="j{k}" type="fixed"><parent link="l{k - 1}"/><child link="l{k}"/></joint>'
                for k in range(1, 5_000)
            )
            + "</robot>",
            "arm.xml: more than 256 links",
            id="5,000 links",
        ),
        pytest.param(
            "mjcf",
            f'<mujoco><worldbody><body name="a"><joint name="universe"/>{INERTIAL}</body></worldbody>'
            '<keyframe><key name="k" qpos="0"/></keyframe></mujoco>',
            "arm.xml: ",
            id="a name that breaks the heap",
        ),
    ],
)
def test_a_mechanism_that_breaks_parsers_leaves_the_daemon_alive(
    daemon: Asked, kind: str, text: str, message: str
) -> None:
    answer = daemon.post("/api/v1/descriptions/check", body(kind, text))
    assert answer.status_code == 422, answer.text
    assert answer.json()["error"]["message"].startswith(f"arm.yaml:4:1: kinematics: {message}")
    # Nobody can add it; known from earlier software and put to use in the daemon itself, it is the same error.
    assert daemon.post("/api/v1/arms", body(kind, text)).json() == answer.json()
    assert daemon.get("/api/v1/arms/spy").status_code == 404
    with suppress(ConfigError):
        add_arm(daemon.service.db, daemon.service.state, ARM.format(kind=kind), {"arm.xml": text}, "test")
        answer = daemon.get("/api/v1/arms/spy/home")
        assert answer.status_code in (400, 422), answer.text
    assert daemon.get("/api/v1/arms").status_code == 200


@pytest.mark.slow
def test_the_daemon_itself_reads_no_urdf_that_is_new(state: Path) -> None:
    configs = Path(__file__).resolve().parents[2] / "configs"
    text = (configs / "threelink.yaml").read_text().replace("name: threelink", "name: mine")
    upload = {"description": text, "files": {"threelink.urdf": (configs / "threelink.urdf").read_text()}}
    with daemon_process(state) as (process, client):
        assert client.post("/api/v1/descriptions/check", upload)["arm"] == "mine"
        assert client.post("/api/v1/arms", upload)["name"] == "mine"
        assert b"mine" in client.content("/arms/mine")
        loaded = Path(f"/proc/{process.pid}/maps").read_text()
    assert "libc" in loaded
    assert "pinocchio" not in loaded


def test_a_description_has_its_own_limit_of_size(daemon: Asked, state: Path) -> None:
    for door in ("arms", "descriptions/check"):
        answer = daemon.post(f"/api/v1/{door}", {"description": "a: 1\n" * 60_000})
        assert answer.status_code == 422, answer.text
        assert "262144" in answer.json()["error"]["message"]


@pytest.mark.slow
def test_few_descriptions_are_checked_at_a_time(daemon: Asked) -> None:
    good = {"description": "extends: planar2\nname: other\n"}
    with ExitStack() as taken:
        for _ in range(MOST_CHECKS):
            taken.enter_context(daemon.service.checks.slot())
        for door in ("arms", "descriptions/check"):
            answer = daemon.post(f"/api/v1/{door}", good)
            assert (answer.status_code, answer.headers["retry-after"]) == (503, "2"), answer.text
        assert daemon.post("/api/v1/stop").status_code == 200
    assert daemon.post("/api/v1/arms", good).status_code == 201


@pytest.mark.parametrize(
    ("named", "read"),
    [
        ("/etc/passwd", ""),
        ("arm.gltf", ""),  # which may take its corners from any file
        ("../../secret.stl", "secret.stl"),
        ("package://robot/meshes/arm.STL", "arm.STL"),
        ("C:\\m\\arm.obj", "arm.obj"),
    ],
)
def test_meshes_of_an_uploaded_urdf_are_those_beside_it(tmp_path: Path, named: str, read: str) -> None:
    urdf = tmp_path / "robot.urdf"
    mesh = f'<collision><geometry><mesh filename="{named}"/></geometry></collision>'
    urdf.write_text(f'<robot name="r"><link name="base">{mesh}</link></robot>')
    _require_own_meshes(urdf)
    (found,) = ET.fromstring(urdf.read_text()).iter("mesh")  # noqa: S314 - written above
    assert found.get("filename") == read


def test_a_urdf_that_could_break_its_parser_is_refused(tmp_path: Path) -> None:
    urdf = tmp_path / "robot.urdf"
    urdf.write_text('<!DOCTYPE robot [<!ENTITY a "b">]><robot name="r"><link name="&a;"/></robot>')
    with pytest.raises(ModelError, match="refused in a URDF"):
        _require_own_meshes(urdf)
