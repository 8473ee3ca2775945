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

from ident_service.config.load import arm_from_json, load_arm, load_recording_format
from ident_service.config.quantities import TextFile
from ident_service.config.shipped import shipped_arms
from ident_service.errors import IdentError
from ident_service.excitation.excitation import read_excitation
from ident_service.excitation.plan import excitation
from ident_service.model.arm_model import arm_model
from ident_service.model.mechanism import read_mechanism
from ident_service.record.cycle import Cycle
from ident_service.record.open import open_recording
from ident_service.record.writer import RecordingWriter
from ident_service.results.parameter_file import read_parameters
from sim_backend.canopen.objects import Objects

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
TABLE = {
    "format": "ident-parameters",
    "version": 1,
    "base_parameters": {
        "expressions": ["Lzz1 + Ia1", "Lxx2 - Lzz2 + 0.3*(m2 + m3) - 1.1*ly3", "fv1", "lx3"],
        "values": [1.0, -0.25, 3e-3, 0.1],
    },
}


def spoil_text(text: str, rng: random.Random) -> str:
    """Some places of it changed as people, editors and enemies change them."""
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


def spoil_json(content: Any, rng: random.Random) -> str:
    """Its text with a few values replaced, or the text itself spoiled."""
    content = json.loads(json.dumps(content))
    for _ in range(rng.randint(0, 3)):
        node = content
        while isinstance(node, dict | list) and node:
            key = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
            if not isinstance(node[key], dict | list) or not node[key] or rng.random() < 0.2:
                node[key] = copy.deepcopy(rng.choice(VALUES))
                if rng.random() < 0.2:
                    del node[key]
                break
            node = node[key]
    text = json.dumps(content)
    return spoil_text(text, rng) if rng.random() < 0.3 else text


def spoil_bytes(data: bytes, rng: random.Random) -> bytes:
    """Some bytes changed, lost or repeated, the lengths that stand before records among them."""
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


Reader = tuple[Callable[[random.Random], bytes], Callable[[Path], Any]]


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reader]:
    """By kind: what spoils a good file, and what reads it."""
    arms = [shipped_arms()[name].read_text() for name in ("planar2", "sixaxis", "wam7_canopen")]
    config = load_arm("planar2")
    motion = json.loads(excitation(arm_model(config), "identification").to_json())
    described = json.loads(config.model_dump_json())
    eds = (shipped_arms()["planar2"].parent / "puck.eds").read_text()
    recording = _mcap(tmp_path_factory.mktemp("fuzz") / "run.mcap")

    def text(*good: str) -> Callable[[random.Random], bytes]:
        return lambda rng: spoil_text(rng.choice(good), rng).encode("utf-8", "replace")

    return {
        "yaml": (text(*arms), _described),
        "format": (text(_FORMAT), load_recording_format),
        "arm.json": (lambda rng: spoil_json(described, rng).encode(), arm_from_json),
        "mjcf": (
            lambda rng: spoil_text(MJCF, rng).encode("utf-8", "replace"),
            lambda path: read_mechanism(TextFile(name="arm.xml", text=path.read_text(encoding="utf-8")), "mjcf"),
        ),
        "eds": (text(eds), lambda path: Objects(path.read_text(encoding="utf-8"), 5)),
        "mcap": (lambda rng: spoil_bytes(recording, rng), _opened),
        "csv": (text(_CSV), _opened),
        "csv.gz": (lambda rng: spoil_bytes(gzip.compress(_CSV.encode()), rng), _opened),
        "motion": (lambda rng: spoil_json(motion, rng).encode(), read_excitation),
        "parameters": (lambda rng: spoil_json(TABLE, rng).encode("utf-8", "replace"), read_parameters),
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


KINDS = ("yaml", "format", "arm.json", "eds", "mcap", "csv", "csv.gz", "motion", "parameters")
_QUIET = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None, suppress_health_check=_QUIET)
def test_a_spoiled_file_is_read_or_refused(readers: dict[str, Reader], kind: str, seed: int) -> None:
    spoil, read = readers[kind]
    read_apart(spoil(random.Random(seed)), read)  # noqa: S311


@pytest.mark.campaign
@pytest.mark.parametrize(("kind", "count"), [*((kind, 10_000) for kind in KINDS), ("mjcf", 500)])
def test_no_file_of_very_many_breaks_its_reader(readers: dict[str, Reader], kind: str, count: int) -> None:
    @given(seed=st.integers(0, 2**32 - 1))
    @settings(max_examples=count, deadline=None, suppress_health_check=_QUIET, database=None)
    def each(seed: int) -> None:
        spoil, read = readers[kind]
        read_apart(spoil(random.Random(seed)), read)  # noqa: S311

    each()
