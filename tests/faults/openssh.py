"""A real OpenSSH server on loopback, with keys of its own; skips where it is not installed."""

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


def trusting(tmp_path: Path, text: str) -> Path:
    """A known-hosts file with this content."""
    path = tmp_path / "known_hosts"
    path.write_text(text)
    return path


@contextmanager
def openssh_server(tmp_path: Path) -> Iterator[tuple[int, Path, Path]]:
    """Port, known-hosts file and key file of a server that runs as long as the block."""
    server = shutil.which("sshd") or next(
        (p for p in ("/usr/sbin/sshd", "/usr/local/sbin/sshd") if Path(p).exists()), None
    )
    keygen = shutil.which("ssh-keygen")
    if server is None or keygen is None:
        pytest.skip("the OpenSSH server is not installed (apt-get install openssh-server)")
    for name in ("host", "user"):
        make = [keygen, "-q", "-t", "ed25519", "-N", "", "-f", str(tmp_path / name)]
        subprocess.run(make, check=True)
    authorized = tmp_path / "authorized"
    authorized.write_text((tmp_path / "user.pub").read_text())
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = tmp_path / "sshd_config"
    config.write_text(
        f"Port {port}\nListenAddress 127.0.0.1\nHostKey {tmp_path / 'host'}\n"
        f"AuthorizedKeysFile {authorized}\nPasswordAuthentication no\nUsePAM no\n"
        f"StrictModes no\nAllowTcpForwarding yes\nPidFile {tmp_path / 'pid'}\n"
    )
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(exist_ok=True)  # the privilege separation folder of Debian
    process = subprocess.Popen(
        [server, "-D", "-e", "-f", str(config)], stderr=subprocess.PIPE, text=True
    )
    deadline_s = time.monotonic() + 10.0
    while time.monotonic() < deadline_s and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                break
        time.sleep(0.05)
    if process.poll() is not None:
        pytest.fail(f"sshd ended: {process.stderr.read()}")
    host = " ".join((tmp_path / "host.pub").read_text().split()[:2])
    known = trusting(tmp_path, f"[127.0.0.1]:{port} {host}\n")
    try:
        yield port, known, tmp_path / "user"
    finally:
        process.terminate()
        process.wait(10.0)
        process.stderr.close()
