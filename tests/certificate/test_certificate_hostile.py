"""The verifier reads anything without harm, and without any numerical package."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from certificate_samples import parameter_file, table_1, text

from ident_service.certificate_verifier import verify
from ident_service.errors import UsageError
from ident_service.estimation.certificate import certify
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.model.base_parameters import base_from_expressions
from ident_service.model.parameter_layout import INERTIAL
from ident_service.operations.verify import verify_file

NAMES = tuple(f"{symbol}1" for symbol in INERTIAL)


def _good() -> dict:  # type: ignore[type-arg]
    base = base_from_expressions(("m1", "Lzz1"), NAMES)
    beta = np.array([1.0, 0.5])
    return parameter_file(beta, base, certify(beta, base, feasible_set("inertia", NAMES)))


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        "null",
        "1",
        "[" * 100_000,
        '{"a":' * 100_000,
        '{"format": "ident-parameters", "version": 1}',
        '{"format": "ident-parameters", "version": 1, "feasibility": 3}',
        '{"format": "ident-parameters", "version": NaN}',
        '{"format": "ident-parameters", "format": "ident-parameters", "version": 1}',
        "\ud800",
    ],
    ids=range(12),
)
def test_what_is_no_parameter_file_fails_with_a_message(content: str) -> None:
    result = verify(content)
    assert result.verdict == "failed"
    assert result.message
    assert result.message.isprintable()


@pytest.mark.parametrize(
    "bad", ["1e999999999", "9" * 100_000, "1/0", "__import__('os')", "nan", "", None, True, [], {"a": "1"}, 1e400]
)
def test_numbers_that_are_none_or_too_large_fail(bad: object) -> None:
    document = _good()
    document["feasibility"]["certificate"]["delta"]["m1"] = bad
    assert verify(text(document)).verdict == "failed"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "bad"),
    [
        ("links", []),
        ("links", ["1e9"]),
        ("links", list(range(1, 100_000))),
        ("links", [0.5]),
        ("set", "none"),
        ("set", ["inertia"]),
        ("blocks", None),
        ("blocks", [{"name": "x", "size": 10**9, "entries": []}]),
        ("blocks", [{"name": "x", "size": 2, "entries": [{"coefficients": {}, "constant": "1"}]}]),
        ("blocks", [{"name": "\x1b[2J", "size": 0, "entries": [{"coefficients": {}, "constant": "1"}]}]),
        ("blocks", [{"name": "x", "size": 0, "entries": [{"coefficients": {"a b": "1"}, "constant": "1"}]}]),
        ("blocks", [{"name": "x", "size": 0, "entries": [{"coefficients": {}, "constant": "0"}]}]),
        ("blocks", [{"name": "link 1: mass and inertia positive", "size": 0, "entries": []}]),
        ("equalities", {}),
        ("delta", {}),
    ],
)
def test_certificates_of_a_wrong_shape_fail(key: str, bad: object) -> None:
    document = _good()
    assert verify(text(document)).verdict == "feasible"
    document["feasibility"]["certificate"][key] = bad
    result = verify(text(document))
    assert result.verdict == "failed"
    assert result.message.isprintable()


def test_base_parameters_are_numbers_and_not_texts() -> None:
    document = _good()
    document["base_parameters"]["values"] = ["1.0", "0.5"]
    assert verify(text(document)).verdict == "failed"


def test_expressions_are_parsed_and_never_evaluated() -> None:
    document = _good()
    for bad in ("__import__('os').system('true')", "m1**2", "(" * 1000 + "m1" + ")" * 1000, "m1 + x", "m1 + m2"):
        document["base_parameters"]["expressions"][0] = bad
        assert verify(text(document)).verdict == "failed"


def test_a_digit_beyond_what_a_float_holds_counts() -> None:
    content = text(_good())
    assert verify(content.replace("[1.0, 0.5]", "[1.0, 0.50]")).verdict == "feasible"
    assert verify(content.replace("[1.0, 0.5]", "[1.0, 0.50000000000000000000000000001]")).verdict == "failed"


def test_verification_needs_no_numerical_package(wam7_data: Path, tmp_path: Path) -> None:
    base, columns = table_1(wam7_data)
    conditions = feasible_set("inertia", base.names)
    for name in ("r1", "r2"):
        certificate = certify(columns[name], base, conditions)
        (tmp_path / f"{name}.json").write_text(text(parameter_file(columns[name], base, certificate)), encoding="utf-8")
    script = (
        "import sys\n"
        "for name in ('numpy', 'scipy', 'clarabel', 'pydantic', 'yaml', 'jsonschema'):\n"
        "    sys.modules[name] = None\n"
        "import json\n"
        "from pathlib import Path\n"
        "from ident_service.operations.verify import verify_file\n"
        "print(json.dumps([verify_file(Path(path)).verdict for path in sys.argv[1:]]))\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "r1.json"), str(tmp_path / "r2.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == ["feasible", "infeasible"]


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        verify_file(tmp_path / "none.json")
    (tmp_path / "latin.json").write_bytes(b'{"a": "\xe9"}')
    assert verify_file(tmp_path / "latin.json").verdict == "failed"
