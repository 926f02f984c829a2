"""The simulated card on a system that has neither pseudo terminals nor signals of an event loop."""

import asyncio
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.serving.server import ServeOptions, check_options, serve

ROOT = Path(__file__).resolve().parents[3]


def test_the_server_needs_no_module_that_only_posix_has() -> None:
    absent = "import sys; sys.modules.update(dict.fromkeys(['tty', 'termios', 'pty', 'fcntl']))"
    done = subprocess.run(
        [sys.executable, "-c", f"{absent}; import pmac_comp.simulator.serving.server"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_pseudo_terminal_is_refused_where_there_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "openpty")
    with pytest.raises(ConfigError, match="no pseudo terminals"):
        check_options(ServeOptions(pty=True))


def test_it_serves_where_an_event_loop_takes_no_signals(
    card: Card, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(*_: object) -> None:
        raise NotImplementedError

    monkeypatch.setattr(asyncio.SelectorEventLoop, "add_signal_handler", refuses)
    said: list[dict[str, Any]] = []

    def ready(endpoints: dict[str, Any]) -> None:
        said.append(endpoints)
        raise KeyboardInterrupt  # as Ctrl-C ends it there

    with pytest.raises(KeyboardInterrupt):
        serve(card, ServeOptions(tcp=0), ready=ready)
    assert said[0]["ready"] is True
