"""F13 (host keys) and F14 (shells) against an SSH server in process, and against OpenSSH."""

import getpass
import logging
import re
import shutil
import subprocess
from pathlib import Path

import paramiko
import pytest

from pmac_comp.base.errors import (
    CommandRefused,
    ConfigError,
    ConnectFailed,
    HostKeyRefused,
    LinkError,
)
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.transport.gpascii import GpasciiTerminal
from tests.contract.scripted_card import PacketPort, ScriptedCard
from tests.faults.openssh import openssh_server, trusting
from tests.faults.socket_peers import card_handler, peer
from tests.faults.ssh_gateway import SECRET, USER, Gateway, ShellStyle

pytestmark = pytest.mark.faults
PACKAGE = Path(__file__).resolve().parents[2] / "pmac_comp"


@pytest.fixture(scope="module")
def keys():
    return [paramiko.ECDSAKey.generate() for _ in range(3)]


@pytest.fixture
def secret(monkeypatch):
    monkeypatch.setenv("BENCH_SECRET", SECRET)


@pytest.fixture
def gateway(keys):
    made = []

    def make(**options) -> Gateway:
        made.append(Gateway(keys[0], **options))
        return made[-1]

    yield make
    for server in made:
        server.close()


def tunnel_url(server: Gateway, port: int, known_hosts: Path, login: str = "") -> str:
    options = f"known_hosts={known_hosts}&{login or 'password_env=BENCH_SECRET'}"
    return f"ssh://{USER}@127.0.0.1:{server.port}/127.0.0.1:{port}?{options}"


@pytest.mark.usefixtures("secret")
def test_a_card_behind_a_gateway(gateway, tmp_path, caplog):
    caplog.set_level(logging.DEBUG)
    card = ScriptedCard(I3=1)
    with peer(card_handler(card, PacketPort)) as server:
        front = gateway(reachable={("127.0.0.1", server.port)})
        known = trusting(tmp_path, front.known_hosts_line)
        with Commander.open(tunnel_url(front, server.port, known)) as commander:
            assert commander.query("ver") == ["1.947  "]
            assert len(commander.query("P0..999")) == 1000
            commander.set_memory(0x400, b"abcd")
            assert commander.get_memory(0x400, 4) == b"abcd"
        assert card.mode("I3") == 1
    assert SECRET not in caplog.text  # F45: no password in any log


def test_a_key_file_serves_as_login(gateway, tmp_path):
    user_key = paramiko.ECDSAKey.generate()
    path = tmp_path / "id_bench"
    user_key.write_private_key_file(str(path))
    with peer(card_handler(ScriptedCard(), PacketPort)) as server:
        front = gateway(reachable={("127.0.0.1", server.port)})
        front.user_key = user_key
        known = trusting(tmp_path, front.known_hosts_line)
        url = tunnel_url(front, server.port, known, f"identity={path}")
        with Commander.open(url) as commander:
            assert commander.query("cid") == ["603382"]
        path.chmod(0o644)
        with pytest.raises(ConfigError, match="others can read"):
            Commander.open(url)


@pytest.mark.usefixtures("secret")
@pytest.mark.parametrize("case", ["unknown", "changed", "no file"])
def test_f13_keys_that_nobody_trusted_are_refused(gateway, keys, tmp_path, case):
    front = gateway(reachable={("127.0.0.1", 1025)})
    other = f"[127.0.0.1]:{front.port} {keys[1].get_name()} {keys[1].get_base64()}\n"
    text = {"unknown": f"elsewhere {keys[2].get_name()} {keys[2].get_base64()}\n", "changed": other}
    known = tmp_path / "absent"
    if case in text:
        known = trusting(tmp_path, text[case])
    before = known.read_bytes() if known.exists() else None
    with pytest.raises(HostKeyRefused) as caught:
        Commander.open(tunnel_url(front, 1025, known))
    error = caught.value
    assert error.exit_code == 3
    assert "SHA256:" in error.message
    assert error.context["fingerprint"] in error.message
    assert str(known) in error.hint
    assert ("ssh-keygen" if case == "changed" else "ssh-keyscan") in error.hint
    assert front.logins == 0
    assert (known.read_bytes() if known.exists() else None) == before  # nothing was added


def test_f13_the_fingerprint_is_openssh_s(keys, tmp_path):
    tool = shutil.which("ssh-keygen")
    if tool is None:
        pytest.skip("ssh-keygen is not installed")
    path = tmp_path / "key.pub"
    path.write_text(f"{keys[0].get_name()} {keys[0].get_base64()} x\n")
    shown = subprocess.run([tool, "-lf", path], capture_output=True, text=True, check=True).stdout
    from pmac_comp.machine.transport.ssh import fingerprint

    assert fingerprint(keys[0]) in shown


def test_f13_no_policy_that_adds_keys_by_itself():
    pattern = re.compile(r"AutoAdd|WarningPolicy|set_missing_host_key_policy\((?!_RefuseUnknown)")
    paths = list(PACKAGE.rglob("*.py"))
    assert PACKAGE / "machine" / "transport" / "ssh.py" in paths
    assert [path for path in paths if pattern.search(path.read_text())] == []
    assert pattern.search("client.set_missing_host_key_policy(paramiko.AutoAddPolicy())")


def test_f46_agent_and_home_keys_are_offered_only_on_request(gateway, tmp_path, monkeypatch):
    offered = {}

    def connect(self, host, *_, **options):
        offered.update(options)
        raise paramiko.AuthenticationException

    monkeypatch.setattr(paramiko.SSHClient, "connect", connect)
    front = gateway()
    known = trusting(tmp_path, front.known_hosts_line)
    with pytest.raises(ConnectFailed):
        Commander.open(tunnel_url(front, 1, known, "agent=no"))
    assert offered["allow_agent"] is False
    assert offered["look_for_keys"] is False
    with pytest.raises(ConnectFailed):
        Commander.open(tunnel_url(front, 1, known, "agent=yes"))
    assert offered["allow_agent"] is True


def test_logins_that_fail_say_what_to_do(gateway, tmp_path, monkeypatch):
    front = gateway()
    known = trusting(tmp_path, front.known_hosts_line)
    bare = tunnel_url(front, 1, known).replace("&password_env=BENCH_SECRET", "")
    with pytest.raises(ConnectFailed, match="no way to log in") as nameless:
        Commander.open(bare)
    assert "?identity=FILE" in nameless.value.hint
    with pytest.raises(ConfigError, match="BENCH_SECRET is not set"):
        Commander.open(tunnel_url(front, 1, known))
    monkeypatch.setenv("BENCH_SECRET", "canary-wrong")
    with pytest.raises(ConnectFailed, match="refuses the login") as caught:
        Commander.open(tunnel_url(front, 1, known))
    assert "canary" not in str(caught.value)
    monkeypatch.setenv("BENCH_SECRET", SECRET)
    with pytest.raises(ConnectFailed, match="does not reach"):
        Commander.open(tunnel_url(front, 1, known))


@pytest.mark.usefixtures("secret")
def test_f13_lines_of_known_hosts_that_are_no_keys_are_passed_over(gateway, tmp_path, keys):
    """One of another host, which nobody has asked for, ended as a bug of ours."""
    front = gateway()
    known = trusting(tmp_path, front.known_hosts_line)
    good, other = known.read_bytes(), keys[1].get_base64()
    junk = f"a.example ssh-ed25519 AAAB3NzaC1lZDI1NTE5\nb.example ssh-rsa {other}\n|1|x\n".encode()
    known.write_bytes(b"\xff\xfe\n# remark\n" + junk + good + b"\0\n")
    with pytest.raises(ConnectFailed, match="does not reach"):
        Commander.open(tunnel_url(front, 1, known))
    known.write_bytes(junk + b"@revoked " + good)
    with pytest.raises(HostKeyRefused):
        Commander.open(tunnel_url(front, 1, known))


@pytest.mark.parametrize(("content", "told"), [("junk", "is no private key"), (None, "passphrase")])
def test_a_key_file_that_cannot_be_used_is_named(gateway, tmp_path, content, told):
    front, key = gateway(), tmp_path / "id"
    known = trusting(tmp_path, front.known_hosts_line)
    if content is None:
        paramiko.RSAKey.generate(2048).write_private_key_file(str(key), password="other")
    else:
        key.write_text(content)
    key.chmod(0o600)
    bare = tunnel_url(front, 1, known).replace("&password_env=BENCH_SECRET", "")
    with pytest.raises(ConfigError, match=told):
        Commander.open(f"{bare}&identity={key}")


STYLES = {
    "plain": ShellStyle(),
    "banner": ShellStyle(banner=b"\x1b[31mWelcome to ASCII art\x1b[0m\r\n" * 20),
    "echo": ShellStyle(echo=True),
    "other prompt": ShellStyle(prompt=b"root@power:/opt/ppmac# "),
    "no prompt": ShellStyle(prompt=b""),
    "command echo": ShellStyle(command_echo=True, echo=True, banner=b"ready?\n"),
}


def gpascii_url(server: Gateway, known: Path) -> str:
    options = f"known_hosts={known}&password_env=BENCH_SECRET"
    return f"gpascii://{USER}@127.0.0.1:{server.port}?{options}"


@pytest.mark.usefixtures("secret")
@pytest.mark.parametrize("name", STYLES)
def test_f14_shells_of_every_kind(gateway, tmp_path, name):
    answers = {"vers": "2.6.1.0", "type": "PowerPMAC,460EX", "bad": "stdin:1:1: error #20: ILLEGAL"}
    front = gateway(style=STYLES[name], answer=answers.__getitem__)
    known = trusting(tmp_path, front.known_hosts_line)
    with GpasciiTerminal(gpascii_url(front, known)) as terminal:
        assert terminal.query("vers") == ["2.6.1.0"]
        assert terminal.query("type") == ["PowerPMAC,460EX"]
        with pytest.raises(CommandRefused, match="error #20"):
            terminal.query("bad")


@pytest.mark.usefixtures("secret")
@pytest.mark.parametrize("lines", [0, 1, 2, 3])
def test_f14_a_channel_that_dies_is_noticed(gateway, tmp_path, lines):
    front = gateway(style=ShellStyle(dies_after=lines))
    known = trusting(tmp_path, front.known_hosts_line)
    with pytest.raises(LinkError):
        GpasciiTerminal(gpascii_url(front, known), timeout_s=3.0).query("vers")


@pytest.mark.usefixtures("secret")
def test_f14_a_machine_without_gpascii_is_refused(gateway, tmp_path):
    front = gateway(style=ShellStyle(has_gpascii=False))
    known = trusting(tmp_path, front.known_hosts_line)
    with pytest.raises(ConnectFailed, match="gpascii does not start"):
        GpasciiTerminal(gpascii_url(front, known), timeout_s=1.0)


# A real OpenSSH server --------------------------------------------------------------------------


@pytest.fixture
def openssh(tmp_path):
    with openssh_server(tmp_path) as gateway:
        yield gateway


@pytest.mark.system
def test_a_card_behind_a_real_openssh_server(openssh, tmp_path):
    port, known, identity = openssh
    with peer(card_handler(ScriptedCard(), PacketPort)) as server:
        url = (
            f"ssh://{getpass.getuser()}@127.0.0.1:{port}/127.0.0.1:{server.port}"
            f"?known_hosts={known}&identity={identity}"
        )
        with Commander.open(url, timeout_s=10.0) as commander:
            assert commander.query("ver") == ["1.947  "]
            assert len(commander.query("P0..999")) == 1000
        known.write_text("")
        with pytest.raises(HostKeyRefused):
            Commander.open(url, timeout_s=10.0)
