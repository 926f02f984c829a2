"""What ``--help`` says agrees with what the commands take."""

import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import DEFAULT, create_autospec

import numpy as np
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from pmac_comp.cli.app import CHANGING, app
from pmac_comp.cli.output import WRITTEN
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.workflow.capture import capturing
from pmac_comp.workflow.compensation import compensate
from pmac_comp.workflow.controller import upload_flow
from pmac_comp.workflow.model import identification
from pmac_comp.workflow.motion.motions import KEYS
from pmac_comp.workflow.verification import verify

PERIOD_S = 442e-6
ROOT = Path(__file__).resolve().parents[3]


def option_help(command: str, option: str) -> str:
    """Text of an option as it is declared."""
    parameters = get_command(app).commands[command].params  # type: ignore[attr-defined]
    return next(str(p.help) for p in parameters if option in p.opts)


@pytest.mark.parametrize("kind", KEYS)
def test_capture_names_every_key_of_a_motion(kind: str) -> None:
    told = re.search(rf"\b{kind}: ([^;]*)", option_help("capture", "--motion"))
    assert told is not None
    assert told.group(1).split() == list(KEYS[kind])


def test_a_wrong_kind_of_memory_of_the_simulated_card_is_a_usage_error() -> None:
    done = CliRunner().invoke(app, ["sim", "--dpram", "huge"])
    assert done.exit_code == 2
    assert "small" in done.output


def test_a_simulation_in_a_hurry_tells_that_dates_are_the_hosts() -> None:
    """A drive that warms within 400 s was found to warm within 18 s."""
    assert "what drifts seems as much faster" in option_help("sim", "--speed")


def test_exit_codes_are_told() -> None:
    said = " ".join(CliRunner().invoke(app, ["--help"]).output.split())
    assert "Exit codes: 0 done, 2 usage" in said


@pytest.mark.parametrize("command", sorted(CHANGING))
def test_every_command_that_changes_something_can_tell_beforehand(command: str) -> None:
    assert "change nothing" in option_help(command, "--dry-run")


def test_a_dry_run_of_improve_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["improve", "tcp://192.0.2.1:1025", "--bench", "paper", "--dry-run"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0
    assert "nothing was changed" in done.output
    assert list(tmp_path.iterdir()) == []


def named_commands() -> Iterator[tuple[str, str, str]]:
    """Where a command line is named to people, its command and the rest of it."""
    for path in (ROOT / "README.md", *sorted((ROOT / "pmac_comp").rglob("*.py"))):
        text = re.sub(r'"\n\s*f?"', "", path.read_text(encoding="utf-8"))
        pasted = re.findall(r"^pmac-comp ([a-z]+)([^`\n]*)$", text, re.MULTILINE)
        for command, rest in re.findall(r"`pmac-comp ([a-z]+)([^`\n]*)`", text) + pasted:
            yield path.relative_to(ROOT).as_posix(), command, rest


def test_commands_named_in_the_readme_and_in_errors_exist_with_their_options() -> None:
    commands = get_command(app).commands  # type: ignore[attr-defined]
    named = list(named_commands())
    assert len(named) > 60
    wrong = []
    for place, command, rest in named:
        known = {o for p in getattr(commands.get(command), "params", []) for o in p.opts}
        unknown = sorted(set(re.findall(r"--[a-z][a-z-]*", rest)) - known - {"--help"})
        if command not in commands or unknown:
            wrong.append((place, command, unknown))
    assert wrong == []


def test_every_option_that_the_readme_names_exists() -> None:
    """`--law` was named for an option that is called `--compensation`."""
    groups = get_command(app).commands.values()  # type: ignore[attr-defined]
    known = {o for c in groups for p in getattr(c, "params", []) for o in p.opts}
    beside = {"--all", "--exhaustive", "--share", "--install-completion"}  # of tests and typer
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text)) - known - beside == set()


def test_files_that_the_readme_names_exist() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:configs|firmware_plc|tools|pmac_comp)/[\w./*-]+)", text)
    named += [f"machine/{name}" for name in re.findall(r"`machine/([\w./]+)`", text)]
    assert len(named) > 12
    roots = (ROOT, ROOT / "pmac_comp")
    assert [name for name in named if not any(list(root.glob(name)) for root in roots)] == []


def test_the_python_of_the_readme_calls_what_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each step takes the place of the real function with its signature, and is called in turn."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    called = []

    def captured(_url: str, _bench: str, _plan: object, out: Path) -> None:
        called.append(f"capture {out}")
        out.mkdir()
        write_capture(out / "a.h5", Capture(*(PERIOD_S * np.arange(4) for _ in range(3))))

    steps = [
        (capturing, "capture_to_folder", captured),
        (identification, "identify_files", None),
        (compensate, "compensate_files", None),
        (upload_flow, "upload_file", None),
        (verify, "verify_on_controller", None),
    ]
    for module, name, done in steps:
        stub = create_autospec(getattr(module, name), side_effect=done)
        if done is None:
            stub.side_effect = lambda *_, _name=name, **__: called.append(_name) or DEFAULT
        monkeypatch.setattr(module, name, stub)
    script = Path("snippet.py")
    script.write_text(block)
    runpy.run_path(str(script))
    assert called == ["capture calibration", "capture lead", *(name for _, name, _ in steps[1:])]


def test_command_lines_to_paste_name_all_that_the_command_requires() -> None:
    commands = get_command(app).commands  # type: ignore[attr-defined]
    incomplete = []
    for place, command, rest in named_commands():
        if not re.search(r"--[a-z-]+ [^- ]", rest):  # a command by its name, not a line to paste
            continue
        required = [p for p in getattr(commands[command], "params", []) if p.required]
        options = [p.opts[0] for p in required if p.opts[0].startswith("-")]
        n_places = len(required) - len(options)
        places = re.findall(r"^(?: [^- ]\S*)*", rest)[0].split()
        if len(places) < n_places or any(option not in rest for option in options):
            incomplete.append((place, command, rest))
    assert incomplete == []


def test_what_a_command_writes_is_known_to_the_check_for_one_file_named_twice() -> None:
    writing = {
        f"{name} {parameter.name}": parameter.name
        for name, command in get_command(app).commands.items()  # type: ignore[attr-defined]
        for parameter in getattr(command, "params", [])
        if "to write" in (parameter.help or "") or "--out" in parameter.opts
    }
    assert len(writing) > 10
    assert {place for place, name in writing.items() if name not in WRITTEN} == set()
