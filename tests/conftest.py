"""What tests share: published data beside the checkout, the WAM's model, how hypothesis searches."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TypeVar

import pytest
from helpers import tickets
from helpers.forks import ForkServer, fork_processes
from hypothesis import settings
from threadpoolctl import threadpool_limits

from ident_service.config.load import load_arm
from ident_service.model.arm_model import ArmModel, arm_model

_Report = TypeVar("_Report", pytest.TestReport, pytest.CollectReport)
_CI = os.environ.get("CI") == "true"
# Small matrices on several BLAS threads are slow, and very slow on a busy machine; child processes inherit this.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Arrow's own pool reserves a gibibyte, which a test that locks this process' memory would fill.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
os.environ.pop("PYTHONUNBUFFERED", None)  # it hides what a buffer does when the command ends
threadpool_limits(limits=1, user_api="blas")
_SHARED = Path(__file__).resolve().parents[2] / "shared"
# The only reasons to skip with CI=true: what no package gives a machine, and what CI runs by a command of its own.
_ALLOWED = (
    "this machine grants no real time",
    "this processor has no AVX2",
    "only root can become somebody else",
    "`make test-socketcan` runs it",
    "`make test-foreign` runs it",
)

# Folders, and files of others, about what a command does and not about how its processes begin, talk and end; those
# with a daemon's threads, which must not be forked with it; and files in these folders that are about processes.
_FORKED = {"cli", "payload"}
_FORKED |= {"test_can_log", "test_finish", "test_recover", "test_runs", "test_zero"}
_FORKED |= {"test_canopen_matrix", "test_canopen_positions"}
_SERVED = {"daemon", "maintenance", "page", "test_fleet_server"}
_STARTED = {"test_answer", "test_cli_itself", "test_image"}

# A part of hypothesis' usual hundred examples; `make campaign` has a thousand, wherever a test says no number.
settings.register_profile("default", deadline=None, derandomize=_CI, print_blob=True, max_examples=25)
settings.register_profile("campaign", deadline=None, print_blob=True, max_examples=1000)
settings.load_profile("default")


def pytest_collection() -> None:
    gc.disable()


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makeitem(collector: pytest.Collector, obj: object) -> list[pytest.Item] | None:
    """Make no items of a function whose thousands of cases are for another time; every worker would, and drop them."""
    marks = getattr(obj, "pytestmark", ()) if "not campaign" in collector.config.getoption("-m") else ()
    return [] if any(mark.name == "campaign" for mark in marks) else None


def pytest_collection_finish() -> None:
    """Take the collected tests off the garbage collector, which else walks them all and leaves runs lying for long."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def interrupts_are_heard() -> Iterator[None]:
    """Hear Ctrl-C, here and in child processes, although a shell that starts a background command ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session", autouse=True)
def tickets_are_shared(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Have each arm checked once for all workers."""
    tickets.factory = tmp_path_factory


@pytest.fixture
def hangups_are_heard() -> Iterator[None]:
    """Hear hangups although the tests were started with `nohup`, which ignores them."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="session", autouse=True)
def fork_server(request: pytest.FixtureRequest) -> Iterator[ForkServer | None]:
    """The process that forks programs for daemons, made before there is any; None at night."""
    if "campaign" in (request.config.getoption("--hypothesis-profile", ""), request.config.getoption("-m")):
        yield None
        return
    server = ForkServer()
    yield server
    server.close()


@pytest.fixture(scope="module", autouse=True)
def processes(request: pytest.FixtureRequest, fork_server: ForkServer | None) -> Iterator[None]:
    """Fork our own programs where `_FORKED` and `_SERVED` say so; at night each is started anew."""
    names = {request.path.parent.name, request.path.stem}
    if fork_server is None or _STARTED & names or not (_FORKED | _SERVED) & names:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        fork_processes(patch, fork_server if _SERVED & names else None)
        yield


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return _unless_missing((yield))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return _unless_missing((yield))


def _unless_missing(report: _Report) -> _Report:
    """Turn a skip into a failure with CI=true, where nothing may be missing."""
    if _CI and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not any(allowed in reason for allowed in _ALLOWED):
            report.outcome, report.longrepr = "failed", f"{reason}\n(with CI=true nothing may be missing)"
    return report


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of published data that stands beside the checkout."""
    if not _SHARED.is_dir():
        pytest.skip(f"needs the published data in {_SHARED.name}/ beside the checkout")
    return _SHARED


@pytest.fixture(scope="session")
def wam7_data(shared: Path) -> Path:
    """Tables, trajectories and CAD parameters of the WAM."""
    return shared / "data" / "wam7"


@pytest.fixture(scope="session")
def wam7() -> ArmModel:
    """The shipped WAM."""
    return arm_model(load_arm("wam7"))
