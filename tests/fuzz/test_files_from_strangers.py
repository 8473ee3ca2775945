"""Spoiled files of every kind that is read: each is read or refused in words, in little time and memory.

A fork of this process reads each, so that a reader that dies is seen. `make campaign` does very many.
"""

from __future__ import annotations

import copy
import gzip
import json
import os
import random
import re
import resource
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.forks import fork
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ident_service.config import load
from ident_service.config import yaml_source as source
from ident_service.config.eds import LONGEST, data_sheet
from ident_service.config.load import arm_from_json, load_arm, load_recording_format
from ident_service.config.quantities import TextFile
from ident_service.config.yaml_source import shipped_arms
from ident_service.errors import DriverError, IdentError
from ident_service.excitation import motion_file as motion_file
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.motion_file import read_excitation
from ident_service.model import mechanism
from ident_service.model.arm_model import arm_model
from ident_service.model.mechanism import Kind, read_mechanism
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.open import open_recording
from ident_service.results import parameter_file
from ident_service.results.parameter_file import read_parameters
from sim_backend.canopen_device.objects import Objects

SECONDS, MEMORY = 2.0, 500 * 2**20
NUMBERS = ("0", "-1", "1e308", "-1e-308", "nan", ".inf", "9" * 30, "1e999", "0x7fffffff", "true", "", "2 pi", "90 deg")
TOKENS = (
    "{",
    "}",
    "[",
    "]",
    ":",
    ",",
    "- ",
    "\n",
    "\t",
    '"',
    "'",
    "\\",
    "<",
    ">",
    "&a",
    "*a",
    "!!x",
    "\x00",
    "µ",
    "=",
    "#",
)
VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1e308,
    10**400,
    "",
    "x" * 1000,
    [],
    {},
    [[]],
    [[1], [2, 3]],
    {"a": [1]},
    "nan",
)
MJCF = (
    '<mujoco><compiler angle="radian"/><worldbody><body name="one"><joint name="turn" axis="0 1 0" range="-1 1"/>'
    '<inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/></body></worldbody></mujoco>'
)
URDF = """<robot name="r"><material name="g"><color rgba="1 0 0 1"/></material>
<link name="l0"><visual><origin xyz="0 0 0" rpy="0 0 0"/><geometry><box size="1 1 1"/></geometry></visual></link>
<link name="l1"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="a.stl" scale="1 1 1"/></geometry></collision></link><link name="l2"/>
<joint name="j1" type="revolute"><parent link="l0"/><child link="l1"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/><dynamics damping="1" friction="2"/></joint>
<joint name="j2" type="prismatic"><parent link="l1"/><child link="l2"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""
TABLE = {
    "format": "ident-parameters",
    "version": 1,
    "base_parameters": {
        "expressions": ["Lzz1 + Ia1", "Lxx2 - Lzz2 + 0.3*(m2 + m3) - 1.1*ly3", "fv1", "lx3"],
        "values": [1.0, -0.25, 3e-3, 0.1],
    },
}


def spoil_text(text: str, rng: random.Random, most: int = 0) -> str:
    """Some places of it changed as people, editors and enemies change them; one in ten grown to `most` bytes."""
    if most and rng.random() < 0.1:
        at, length = rng.randrange(len(text)), rng.choice((1, 2, 5, 20, 100, 1000))
        piece = text[at : at + length] if rng.random() < 0.7 else rng.choice(TOKENS)
        text = text[:at] + piece * ((most - len(text.encode())) // len(piece.encode())) + text[at:]
    for _ in range(rng.randint(1, 4)):
        at, length = rng.randrange(len(text) + 1), rng.choice((1, 3, 20, 200))
        match rng.randrange(7):
            case 0:
                text = text[:at] + text[at + length :]
            case 1:
                text = text[:at] + text[at : at + length] * rng.choice((2, 3, 300)) + text[at:]
            case 2:
                text = text[:at] + rng.choice(TOKENS) * rng.choice((1, 1, 500)) + text[at:]
            case 3:
                text = text[:at]
            case 4 | 5:
                if numbers := list(re.finditer(r"-?\d+(\.\d+)?(e-?\d+)?", text)):
                    chosen = rng.choice(numbers)
                    text = text[: chosen.start()] + rng.choice(NUMBERS) + text[chosen.end() :]
            case _:
                lines = text.split("\n")
                rng.shuffle(lines)
                text = "\n".join(lines)
    return text


def spoil_json(content: Any, rng: random.Random, most: int = 0) -> str:
    """Its text with a few values replaced, or the text itself spoiled; one in ten grown to `most` bytes."""
    content = json.loads(json.dumps(content))
    for _ in range(rng.randint(0, 3)):
        node = content
        while isinstance(node, dict | list) and node:
            key = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
            if not isinstance(node[key], dict | list) or not node[key] or rng.random() < 0.2:
                node[key] = copy.deepcopy(rng.choice(VALUES))
                if rng.random() < 0.2:
                    del node[key]
                elif most and rng.random() < 0.1:
                    value = json.dumps(rng.choice(VALUES))
                    node[key] = [json.loads(value)] * ((most - len(json.dumps(content))) // (len(value) + 2))
                break
            node = node[key]
    text = json.dumps(content)
    return spoil_text(text, rng, most) if rng.random() < 0.3 else text


def spoil_bytes(data: bytes, rng: random.Random, most: int = 0) -> bytes:
    """Some bytes changed, lost or repeated, lengths before records among them; one in ten grown to `most` bytes."""
    if most and rng.random() < 0.1:
        at, length = rng.randrange(len(data)), rng.choice((1, 9, 100, 10_000))
        data = data[:at] + data[at : at + length] * ((most - len(data)) // length) + data[at:]
    for _ in range(rng.randint(1, 6)):
        at, length = rng.randrange(len(data) + 1), rng.choice((1, 1, 4, 8, 100))
        match rng.randrange(5):
            case 0:
                data = data[:at] + rng.randbytes(length) + data[at + length :]
            case 1:
                data = data[:at] + data[at + length :]
            case 2:
                data = data[:at] + data[at : at + length] + data[at:]
            case 3:
                data = data[:at] + rng.choice((b"\xff", b"\x00", b"\x7f")) * length + data[at + length :]
            case _:
                data = data if rng.random() < 0.7 else data[:at]
    return data


def _mcap(path: Path) -> bytes:
    with RecordingWriter(path, ("one", "two"), '<robot name="r"/>', 5) as writer:
        for k in range(200):
            q = np.array([0.01 * k, 0.02 * k])
            writer.sample(Cycle(k * 1_000_000, q, None, q, q, q, k, 1, 1, np.ones(2, bool), np.zeros(2), 0))
    return path.read_bytes()


_CSV = "t,q1,q2,tau1,tau2\n" + "".join(f"{0.01 * k},{0.1 * k},{-0.1 * k},1.5,{k}\n" for k in range(60))
_FORMAT = "csv: {time: t, time_unit: ms, position: [a, b], torque: [c, d]}\n"


def _opened(path: Path) -> None:
    for _ in open_recording(path).blocks(64):
        pass


def _described(path: Path) -> None:
    arm_model(load_arm(path))


def _mechanism(kind: Kind) -> Callable[[Path], Any]:
    return lambda path: read_mechanism(TextFile(name=f"arm.{kind}", text=path.read_text(encoding="utf-8")), kind)


def _eds(path: Path) -> None:
    """As a description's check does, then the drive that is emulated."""
    text = path.read_text(encoding="utf-8")
    if why := data_sheet(text).mistake:
        raise DriverError(why)
    Objects(text, 5)


Reader = tuple[Callable[[random.Random, bool], bytes], Callable[[Path], Any]]
# Bytes that a file of the kind may have; of recordings, what is read in the time.
LIMITS = {
    "yaml": source.MOST_BYTES,
    "format": source.MOST_BYTES,
    "arm.json": load._MOST_JSON,
    "urdf": mechanism.MOST_BYTES,
    "mjcf": mechanism.MOST_BYTES,
    "eds": LONGEST,
    "mcap": 2**22,
    "csv": 2**22,
    "csv.gz": 2**20,
    "motion": motion_file._MOST_BYTES,
    "parameters": parameter_file.MAX_BYTES,
}


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reader]:
    """By kind: what spoils a good file, and what reads it."""
    arms = [shipped_arms()[name].read_text() for name in ("planar2", "sixaxis", "wam7_canopen")]
    config = load_arm("planar2")
    motion = json.loads(excitation(arm_model(config), "identification").to_json())
    described = json.loads(config.model_dump_json())
    eds = (shipped_arms()["planar2"].parent / "emulated_drive.eds").read_text()
    recording = _mcap(tmp_path_factory.mktemp("fuzz") / "run.mcap")

    def text(kind: str, *good: str) -> Callable[[random.Random, bool], bytes]:
        return lambda rng, large: spoil_text(rng.choice(good), rng, LIMITS[kind] * large).encode("utf-8", "replace")

    def tree(kind: str, good: Any) -> Callable[[random.Random, bool], bytes]:
        return lambda rng, large: spoil_json(good, rng, LIMITS[kind] * large).encode("utf-8", "replace")

    def binary(kind: str, good: bytes) -> Callable[[random.Random, bool], bytes]:
        return lambda rng, large: spoil_bytes(good, rng, LIMITS[kind] * large)

    return {
        "yaml": (text("yaml", *arms), _described),
        "format": (text("format", _FORMAT), load_recording_format),
        "arm.json": (tree("arm.json", described), arm_from_json),
        "urdf": (text("urdf", URDF), _mechanism("urdf")),
        "mjcf": (text("mjcf", MJCF), _mechanism("mjcf")),
        "eds": (text("eds", eds), _eds),
        "mcap": (binary("mcap", recording), _opened),
        "csv": (text("csv", _CSV), _opened),
        "csv.gz": (binary("csv.gz", gzip.compress(_CSV.encode())), _opened),
        "motion": (tree("motion", motion), read_excitation),
        "parameters": (tree("parameters", TABLE), read_parameters),
    }


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def read_apart(data: bytes, read: Callable[[Path], Any]) -> None:
    """Read a file in a fork: an answer or an error of ours, within the limits."""
    with tempfile.TemporaryDirectory() as folder:
        path, said = Path(folder) / "file.yaml", Path(folder) / "said"
        path.write_bytes(data)
        child = fork()
        if child == 0:
            code = 1
            try:
                os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT), 2)
                most = _address_space() + MEMORY
                resource.setrlimit(resource.RLIMIT_AS, (most, most))
                resource.setrlimit(resource.RLIMIT_CPU, (10, 10))
                read(path)
                code = 0
            except IdentError as error:
                code = 0 if str(error) and len(str(error)) < 100_000 else 2
            except BaseException:  # noqa: BLE001 - it is told below
                traceback.print_exc()
            finally:
                os._exit(code)
        _, status, used = os.wait4(child, 0)
        assert status == 0, f"{said.read_text()[-2000:]}\n{data[:3000]!r}"
        assert used.ru_utime + used.ru_stime < SECONDS, data[:3000]


_QUIET = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]


@pytest.mark.slow
@pytest.mark.parametrize("kind", LIMITS)
def test_a_spoiled_file_is_read_or_refused(readers: dict[str, Reader], kind: str) -> None:
    # A process reads each MJCF.
    @given(seed=st.integers(0, 2**32 - 1))
    @settings(max_examples=3 if kind == "mjcf" else 8, deadline=None, suppress_health_check=_QUIET)
    def each(seed: int) -> None:
        spoil, read = readers[kind]
        read_apart(spoil(random.Random(seed), False), read)  # noqa: S311

    each()


@pytest.mark.campaign
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", LIMITS)
def test_no_file_of_very_many_breaks_its_reader(readers: dict[str, Reader], kind: str) -> None:
    @given(seed=st.integers(0, 2**32 - 1))
    @settings(max_examples=400 if kind == "mjcf" else 1000, deadline=None, suppress_health_check=_QUIET, database=None)
    def each(seed: int) -> None:
        spoil, read = readers[kind]
        data = spoil(random.Random(seed), True)  # noqa: S311
        read_apart(data[: LIMITS[kind]], read)

    each()


def _table(*expressions: str) -> str:
    return json.dumps({**TABLE, "base_parameters": {"expressions": expressions, "values": [1.0] * len(expressions)}})


def _columns(count: int) -> str:
    names = [f"{kind}{number}" for kind in ("q", "tau") for number in range(1, count)]
    return ",".join(["t", *names]) + "\n" + ",".join(["0"] * (2 * count - 1)) + "\n"


def _star() -> str:
    links = "".join(f'<link name="l{k}"/>' for k in range(mechanism.MOST_LINKS))
    ends = '<parent link="l0"/><child link="l{k}"/><axis xyz="0 0 1"/>'
    limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
    joints = (f'<joint name="j{k}" type="revolute">{ends.format(k=k)}{limit}</joint>' for k in range(1, 256))
    return f'<robot name="r">{links}{"".join(joints)}</robot>'


# What took longest or most, the worst of each kind that was found: 55 s and 1.2 GB of a URDF, 56 s of parameters, 57 s
# of a header, 6 s of an EDS, minutes of a list of wrong words, 13 s and 3 GB of a description's JSON; and a motion
# whose kind of 2 MB was the answer.
LARGEST: dict[str, Callable[[], tuple[str, str]]] = {
    "attributes": lambda: ("urdf", "<robot " + " ".join(f"a{k}='1'" for k in range(150_000)) + "/>"),
    "joints of one link": lambda: ("urdf", _star()),
    "aliases": lambda: ("yaml", "a: &a [1, 1]\n" + "".join(f"b{k}: [*a, *a, *a]\n" for k in range(10_000))),
    "wrong terms": lambda: ("yaml", "extends: planar2\nterms: [" + "iscous, " * 25_000 + "offset]\n"),
    "lists": lambda: ("yaml", "a: [" + "1," * 130_000),
    "sums of 200 links": lambda: ("parameters", _table(*(f"m199 + {k + 1}*m{k % 199 + 1}" for k in range(20_000)))),
    "long sums": lambda: ("parameters", _table(*[" + ".join(f"{k}*m{k % 9 + 1}" for k in range(7000))] * 5)),
    "wrong values": lambda: ("parameters", _table("m1").replace("1.0", "1.0," + "[[]]," * 1_600_000 + "2")),
    "a wrong format": lambda: ("parameters", _table("m1").replace('"ident-parameters"', "[" + "1," * 4_000_000 + "2]")),
    "columns": lambda: ("csv", _columns(50_000)),
    "as many columns as may be": lambda: ("csv", _columns(2048)),
    "empty lines": lambda: ("eds", "\n" * LONGEST),
    "lines without a key": lambda: ("eds", "[DeviceInfo]\na=1\n" + "O\n" * (LONGEST // 2 - 20)),
    "more lines": lambda: ("eds", "\n" * 8_000_000),
    "a kind of 2 MB": lambda: ("motion", json.dumps({"format": "ident-excitation", "version": 1, "kind": "x" * 2**21})),
    "empty lists": lambda: ("arm.json", "[" + "[]," * 1_390_000 + "[]]"),
    "many empty lists": lambda: ("arm.json", "[" + "[]," * 20_000_000 + "[]]"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGEST)
def test_a_large_file_is_read_or_refused(readers: dict[str, Reader], name: str) -> None:
    kind, text = LARGEST[name]()
    read_apart(text.encode(), readers[kind][1])
