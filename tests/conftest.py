"""What tests share: published data beside the checkout, the WAM's model, how hypothesis searches."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

from ident_service.config.load import load_arm
from ident_service.model.arm_model import ArmModel, arm_model

_CI = os.environ.get("CI") == "true"
# Small matrices on several BLAS threads are slow, and very slow on a busy machine; child processes inherit this.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
threadpool_limits(limits=1, user_api="blas")
_SHARED = Path(__file__).resolve().parents[2] / "shared"

settings.register_profile("default", deadline=None, derandomize=_CI, print_blob=True)
settings.load_profile("default")


@pytest.fixture(scope="session", autouse=True)
def interrupts_are_heard() -> Iterator[None]:
    """A shell that starts the tests in its background tells them, and whatever they start, to ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def hangups_are_heard() -> Iterator[None]:
    """Whoever runs the tests may have told them to ignore hangups, as `nohup` does."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of published data that stands beside the checkout."""
    if not _SHARED.is_dir():
        reason = f"needs the published data in {_SHARED.name}/ beside the checkout"
        if _CI:
            pytest.fail(reason)
        pytest.skip(reason)
    return _SHARED


@pytest.fixture(scope="session")
def wam7_data(shared: Path) -> Path:
    """Tables, trajectories and CAD parameters of the WAM."""
    return shared / "data" / "wam7"


@pytest.fixture(scope="session")
def wam7() -> ArmModel:
    """The shipped WAM."""
    return arm_model(load_arm("wam7"))
