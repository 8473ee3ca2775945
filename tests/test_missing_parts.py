"""A part that this machine lacks is skipped with its reason, and fails with CI=true."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
TESTS = """
import pytest

def test_of_a_browser():
    pytest.skip("no Chromium on this machine")

@pytest.mark.skipif(True, reason="no systemd-analyze")
def test_of_units():
    pass

@pytest.fixture(scope="module")
def compiler():
    pytest.skip("needs gcc")

def test_of_a_header(compiler):
    pass

def test_of_a_schedule():
    pytest.skip("this machine grants no real time")

@pytest.mark.xfail(strict=True)
def test_of_a_known_limit():
    raise AssertionError

def test_that_passes():
    pass
"""
MODULE = 'import pytest\npytest.importorskip("a_library_of_nobody", exc_type=ImportError)\n'
REASONS = ("no Chromium on this machine", "no systemd-analyze", "needs gcc", "could not import 'a_library_of_nobody'")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ci", "summary"),
    [
        ("", "1 passed, 5 skipped, 1 xfailed"),
        # Tests whose preparation fails are errors, and so is a file that cannot be collected.
        ("true", "1 failed, 1 passed, 1 skipped, 1 xfailed, 3 errors"),
    ],
)
def test_what_is_missing_is_reported_and_fails_in_ci(tmp_path: Path, ci: str, summary: str) -> None:
    (tmp_path / "test_parts.py").write_text(TESTS)
    (tmp_path / "test_module.py").write_text(MODULE)
    words = ("-q", "-rs", "--color=no", "--continue-on-collection-errors", "-c", os.devnull, "--rootdir", tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words, "-p", "conftest", "-p", "no:cacheprovider", tmp_path],
        env={**os.environ, "PYTHONPATH": str(HERE), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "CI": ci},
        capture_output=True,
        text=True,
    )
    said = done.stdout + done.stderr
    assert summary in said
    assert done.returncode == (1 if ci else 0)
    for reason in REASONS:
        assert reason in said
    assert said.count("(with CI=true nothing may be missing)") == (len(REASONS) if ci else 0)
