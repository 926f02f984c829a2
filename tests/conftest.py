"""Options and fixtures shared by all tests."""

import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from pmac_comp.physics.compensate import search
from pmac_comp.workflow.capture import axis_setup
from tests.fault_table import (  # noqa: F401 - hooks and a fixture that pytest finds by name
    count_places,
    count_runs,
    pytest_runtest_logreport,
    pytest_runtest_makereport,
    pytest_terminal_summary,
    set_share,
)

ROOT = Path(__file__).resolve().parent.parent
settings.register_profile(
    "ci",
    max_examples=100,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(
    "long",
    max_examples=3000,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile(os.environ.get("PMAC_COMP_HYPOTHESIS", "ci"))


def pytest_configure(config: pytest.Config) -> None:
    """Choose the long profile for the exhaustive run, and undo an ignored Ctrl-C.

    A background job inherits the latter and hands it on to what tests start.
    """
    if config.getoption("--exhaustive"):
        settings.load_profile("long")
        set_share(config.getoption("--share"))
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--exhaustive",
        action="store_true",
        default=False,
        help="run every byte, line and step of the finite fault lists, and the slow tests",
    )
    parser.addoption(
        "--share",
        type=float,
        default=1.0,
        help="with --exhaustive: a random share of the lists that run over bytes, seed fixed",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--exhaustive"):
        return
    skip = pytest.mark.skip(reason="slow: part of tools/test --all")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)


_WHOLE_SEARCH = {name: getattr(search, name) for name in ("_MOST_ROUNDS", "_COMPASS_ROUNDS")}


@pytest.fixture
def whole_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Laws are searched as users get them."""
    for name, rounds in _WHOLE_SEARCH.items():
        monkeypatch.setattr(search, name, rounds)


@pytest.fixture(scope="session", autouse=True)
def laws_are_searched_shortly() -> Iterator[None]:
    """The search of a law takes seconds, with play most of a minute: tests of others go without.

    ``test_search`` and ``test_design`` test the search; the commands that the system tests start do
    all of it.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_MOST_ROUNDS", 1)
        patch.setattr(search, "_COMPASS_ROUNDS", 0)
        yield


@pytest.fixture(scope="session", autouse=True)
def _journals_apart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Axes without a folder of their own keep their journals apart, and not in the work tree."""
    root = tmp_path_factory.mktemp("journals")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        patch.setattr(axis_setup, "default_store", lambda: Path(tempfile.mkdtemp(dir=root)))
        yield


@pytest.fixture(scope="session")
def exhaustive(request: pytest.FixtureRequest) -> bool:
    """Whether finite fault lists are run in full."""
    return bool(request.config.getoption("--exhaustive"))


@pytest.fixture(scope="session")
def emps_file() -> Path:
    """The EMPS record where it lies: ``PMAC_COMP_EMPS``, else a folder beside the project.

    Skips where it is in neither.
    """
    folder = Path(os.environ.get("PMAC_COMP_EMPS", ROOT.parent / "shared" / "data" / "emps"))
    path = folder / "DATA_EMPS.mat" if folder.is_dir() else folder
    if not path.is_file():
        pytest.skip("the EMPS record is absent; PMAC_COMP_EMPS names its folder")
    return path.resolve()
