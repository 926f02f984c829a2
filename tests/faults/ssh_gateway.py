"""An SSH gateway in process: logins, tunnels to loopback ports, and a shell that plays gpascii."""

import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass

import paramiko

USER = "bench"
SECRET = "canary-9d41"


@dataclass(frozen=True)
class ShellStyle:
    """What a login shell prints around what is asked of it."""

    banner: bytes = b""
    prompt: bytes = b"$ "
    echo: bool = False
    has_gpascii: bool = True
    dies_after: int | None = None
    command_echo: bool = False


class _Server(paramiko.ServerInterface):
    def __init__(self, gateway: "Gateway") -> None:
        self._gateway = gateway
        self.targets: dict[int, tuple[str, int]] = {}
        self.shells: set[int] = set()

    def check_auth_password(self, username, password):
        right = username == USER and password == SECRET
        return paramiko.AUTH_SUCCESSFUL if right else paramiko.AUTH_FAILED

    def check_auth_publickey(self, username, key):
        known = username == USER and key == self._gateway.user_key
        return paramiko.AUTH_SUCCESSFUL if known else paramiko.AUTH_FAILED

    def get_allowed_auths(self, username):
        return "password,publickey"

    def check_channel_request(self, kind, chanid):
        if kind == "session":
            return paramiko.OPEN_SUCCEEDED
        return paramiko.OPEN_FAILED_ADMINISTRATIVELY_PROHIBITED

    def check_channel_direct_tcpip_request(self, chanid, origin, destination):
        if destination not in self._gateway.reachable:
            return paramiko.OPEN_FAILED_CONNECT_FAILED
        self.targets[chanid] = destination
        return paramiko.OPEN_SUCCEEDED

    def check_channel_shell_request(self, channel):
        self.shells.add(channel.get_id())
        return True


class Gateway:
    """A listening gateway; ``known_hosts`` text and keys are given to the test."""

    def __init__(
        self,
        host_key: paramiko.PKey,
        *,
        reachable: set[tuple[str, int]] | None = None,
        style: ShellStyle | None = None,
        answer: Callable[[str], str] = lambda text: text,
    ) -> None:
        self.host_key = host_key
        self.user_key: paramiko.PKey | None = None
        self.reachable = reachable or set()
        self.style = style or ShellStyle()
        self.answer = answer
        self.logins = 0
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self._transports: list[paramiko.Transport] = []
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @property
    def known_hosts_line(self) -> str:
        name = f"[127.0.0.1]:{self.port}"
        return f"{name} {self.host_key.get_name()} {self.host_key.get_base64()}\n"

    def close(self) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        for transport in self._transports:
            transport.close()
        self._thread.join(5.0)
        self._socket.close()

    def _listen(self) -> None:
        while True:
            try:
                link, _ = self._socket.accept()
            except OSError:
                return
            server = _Server(self)
            try:
                transport = paramiko.Transport(link)
                self._transports.append(transport)
                transport.add_server_key(self.host_key)
                transport.start_server(server=server)
            except (paramiko.SSHException, EOFError, OSError):
                continue  # a client that refused our key is gone before we are ready
            threading.Thread(target=self._serve, args=(transport, server), daemon=True).start()

    def _serve(self, transport: paramiko.Transport, server: _Server) -> None:
        channel = transport.accept(10.0)
        if channel is None:
            return
        self.logins += 1
        target = server.targets.get(channel.get_id())
        try:
            if target is not None:
                _pump(channel, target)
            else:
                _Shell(channel, self.style, self.answer).run()
            channel.close()
        except (OSError, EOFError):
            return


def _pump(channel: paramiko.Channel, target: tuple[str, int]) -> None:
    with socket.create_connection(target) as link:

        def back() -> None:
            try:
                while data := link.recv(4096):
                    channel.sendall(data)
                channel.close()
            except (OSError, EOFError):
                return  # the other end of the tunnel went first

        thread = threading.Thread(target=back, daemon=True)
        thread.start()
        while data := channel.recv(4096):
            link.sendall(data)
        link.shutdown(socket.SHUT_RDWR)
        thread.join(2.0)


class _Shell:
    def __init__(
        self, channel: paramiko.Channel, style: ShellStyle, answer: Callable[[str], str]
    ) -> None:
        self._channel = channel
        self._style = style
        self._answer = answer
        self._in_gpascii = False
        self._lines = 0

    def run(self) -> None:
        self._channel.sendall(self._style.banner + self._style.prompt)
        pending = b""
        while data := self._channel.recv(4096):
            pending += data
            while b"\n" in pending:
                line, _, pending = pending.partition(b"\n")
                if self._lines == self._style.dies_after:
                    return
                self._lines += 1
                self._take(line.decode())

    def _take(self, line: str) -> None:
        if self._style.echo and not self._in_gpascii:
            self._channel.sendall(line.encode() + b"\r\n")
        if self._in_gpascii:
            echo = line.encode() + b"\r\n" if self._style.command_echo else b""
            text = "" if line.startswith("echo") else self._answer(line) + "\r\n"
            self._channel.sendall(echo + text.encode() + b"\x06\r\n")
        elif line.startswith("echo "):
            self._channel.sendall(line[5:].replace('"', "").encode() + b"\n" + self._style.prompt)
        elif line.startswith("gpascii") and self._style.has_gpascii:
            self._in_gpascii = True
            self._channel.sendall(b"STDIN Open for ASCII Input\r\n")
        else:
            self._channel.sendall(b"sh: not found\n" + self._style.prompt)
