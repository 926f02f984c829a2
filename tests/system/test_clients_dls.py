"""Other people's clients, unmodified, against the served card.

They live in an environment of their own (``tools/clients-setup``); without it these tests skip.
"""

import json
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.serving.server import ServeOptions, running_server

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-clients" / "bin" / "python"
CLIENTS = Path(__file__).resolve().parent / "clients"

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not PYTHON.exists(), reason="tools/clients-setup has not been run"),
]


@pytest.fixture(scope="module")
def endpoints() -> Iterator[dict[str, str]]:
    card = Card(load_bench("paper"))
    with running_server(card, ServeOptions(tcp=0, ascii_port=0, pty=True, speed="10")) as found:
        yield found


def port_of(url: str) -> str:
    match = re.search(r":(\d+)", url.partition("//")[2])
    assert match is not None
    return match[1]


def run(script: str, *arguments: str, timeout_s: float = 280.0) -> str:
    done = subprocess.run(
        [str(PYTHON), str(CLIENTS / script), *arguments],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen", "PYTHONPATH": ""},
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


def last_json(output: str) -> dict:
    return json.loads(output.strip().splitlines()[-1])


@pytest.mark.parametrize("kind", ["ethernet", "telnet", "serial"])
def test_pmaclib_talks_jogs_and_gets_errors_right(endpoints: dict[str, str], kind: str) -> None:
    if kind == "serial":
        arguments = (endpoints["pty"].removeprefix("serial://"), "38400")
    else:
        url = endpoints["tcp" if kind == "ethernet" else "ascii"]
        arguments = ("127.0.0.1", port_of(url))
    result = last_json(run("pmaclib.py", kind, *arguments))
    assert not result["connect"]
    assert result["cid"][0].startswith("603382\r")
    assert re.fullmatch(r"\d+\.\d+\s*\r\x06", result["ver"][0])
    assert result["i102"] == ["$78002\r\x06", True]
    assert "ERR003" in result["nonsense"][0]
    assert result["p5"][0] == "3.25\r\x06"
    assert result["m500"][0] == "200\r\x06"
    assert result["i122"][0] == "77\r\x06"
    assert result["m162->"][0] == "D:$8B\r\x06"
    assert len(result["i100..131"][0].split("\r")) == 33
    assert float(result["position"].split("\r")[0]) == pytest.approx(12345, abs=3)
    assert result["axes"] == 8
    assert result["model"] == ["Geo Brick (3U Turbo PMAC2)", "Geobrick", 603382]
    assert result["geobrick"] == [True, False]
    assert result["ivars"] == ["$78002", "$3501", "139449"]
    assert result["setup"] == ["80", "$20001"]
    assert result["onboard"][1] == "1"
    for move in ("to", "inc", "dec"):
        assert result[move] == ["\x06", pytest.approx(0, abs=3)]
    assert result["continuous"] == ["\x06", "\x06"]
    assert [answer[0] for answer in result["limits"]] == ["i124=$1", "$1\r\x06", "i124=$20001"]
    assert result["home"] == "\x06"
    assert [entry[0] for entry in result["series"]] == [True, True, False, True]
    assert "ERR" in result["series"][2][3]
    assert result["listing"] == "P1=P1+1\rRET\r\x06"
    assert result["cancelled"] == "1\r\x06"
    assert result["save"][1]
    assert result["again"] == "12.5\r\x06"


def test_pmacanalyse_reads_the_whole_configuration(
    endpoints: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "results").mkdir()
    law = (ROOT / "firmware_plc" / "feedforward_law.plc0").read_text()
    statements = [line.split(";")[0].strip() for line in law.splitlines()]
    with Commander.open(endpoints["tcp"]) as link:
        link.write_buffer([line for line in statements if line])
        link.write_buffer(["&3#4->100X+7", "OPEN PROG 42 CLEAR", "LINEAR X10 DWELL5", "CLOSE"])
    run("analyse.py", "127.0.0.1", port_of(endpoints["tcp"]), str(tmp_path))
    text = (tmp_path / "bench.pmc").read_text()
    assert "i130=139449" in text
    assert "m162->D:$8b" in text
    assert len(text.splitlines()) > 25_000
    squeezed = re.sub(r"\s", "", text).lower()
    for line in statements:
        if line and "plc0clear" not in line.replace(" ", "").lower():
            assert re.sub(r"\s", "", line).lower() in squeezed, line
    assert "&3#4->100x+7" in text.lower()
    assert "openprogram42" in squeezed or "openprog42" in squeezed
    assert (tmp_path / "results" / "bench_compare.htm").exists()


def test_backup_bl_saves_and_restores_positions(endpoints: dict[str, str], tmp_path: Path) -> None:
    result = last_json(run("backup.py", "127.0.0.1", port_of(endpoints["tcp"]), str(tmp_path)))
    assert "M162 = " + str(1234 * 3072) in result["positions"]
    assert float(result["moved"].rstrip("\r\x06")) == pytest.approx(0, abs=3072)
    restored = int(result["restored"].rstrip("\r\x06"))
    assert restored / 3072 == pytest.approx(1234, abs=0.2)
    assert result["configuration"] > 100_000


def test_pmaccontrol_serves_every_window(endpoints: dict[str, str], tmp_path: Path) -> None:
    port = port_of(endpoints["tcp"])
    result = last_json(run("control.py", "127.0.0.1", port, str(tmp_path)))
    assert result["problems"] == []
    assert result["identity"]
    assert result["rows"] == 8
    assert float(result["polled"]) == pytest.approx(0, abs=20000)
    assert result["jog_positive"] == pytest.approx(1500, abs=3)
    assert result["jog_negative"] == pytest.approx(0, abs=3)
    assert result["jog_continuous"] > 1000
    assert result["jog_to"] == pytest.approx(2500, abs=3)
    assert result["killed"].startswith("84")
    assert result["all_killed"].startswith("84")
    assert {"Motor activated", "Open loop mode", "Home Complete"} <= set(result["lit_motor"])
    assert "X-CS Used in Feedrate Calculations" in result["lit_cs"]
    assert result["lit_global"] == ["Fixed Buffer Full", "UMAC System", "This Card Addressed"]
    assert float(result["feed"]) == pytest.approx(50)
    assert [value for _, value in result["watches"][:2]] == ["0", "139449"]
    assert result["watch_edited"] == "3.25"
    assert result["settings"]["30"] == "139449"
    assert result["i122"] == "44"
    assert result["energised"] == "1"
    assert "command 'NO SUCH WORD' generated 'ERR003" in result["shell"]
    assert result["loaded"] == ["7", "P501=P501+1\rRET", True]
    assert "1.947" in result["typed"]
    first, second = result["channels"]
    assert len(first) == len(second)
    assert len(first) >= 500
    assert first[-1] == pytest.approx(2000, abs=3)


# Where each homing type ends, counts; the rest ends on its home position.
AFTER_HOMING = {
    "post_high": 200000,
    "post_low": -5000,
    "post_relative": 5000,
    "post_absolute": 7000,
}


def test_motorhome_plcs_of_every_type_home_the_axis(tmp_path: Path) -> None:
    card = Card(load_bench("paper"))
    with running_server(card, ServeOptions(tcp=0, speed="max")) as endpoints:
        port = port_of(endpoints["tcp"])
        results = last_json(run("motorhome.py", "127.0.0.1", port, str(tmp_path)))
    assert len(results) == 21
    for name, result in results.items():
        assert result["refused"] == [], name
        assert (result["state"], result["status"], result["homed"]) == ("7", "0", "1"), name
    at = {name: result["position"] for name, result in results.items()}
    hard = {name: at.pop(name) for name in ("post_hard_high", "post_hard_low")}
    travel = [b - a for a, b in (result["limits"] for result in results.values())]
    assert hard["post_hard_high"] - hard["post_hard_low"] == pytest.approx(max(travel), abs=400)
    assert at.pop("post_initial") == pytest.approx(results["post_initial"]["start"], abs=50)
    for name, position in at.items():
        assert position == pytest.approx(AFTER_HOMING.get(name, 0), abs=5), name
