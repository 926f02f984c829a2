"""SSH: a tunnel to a PMAC behind a gateway, and the login that ``gpascii`` shares.

What lives here: host keys, logins, channels. Only keys a person has already trusted are accepted;
nothing here ever adds one. No password is taken from an address or kept anywhere: it comes from
an environment variable that the address names.
"""

import base64
import hashlib
import os
import socket
from pathlib import Path

import paramiko

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import ConfigError, ConnectFailed, HostKeyRefused
from pmac_comp.machine.transport.tcp import SocketTransport
from pmac_comp.machine.transport.url import Endpoint

DEFAULT_KNOWN_HOSTS = "~/.ssh/known_hosts"
_SHORTEST_WAIT_s = 1e-3
_KEEPALIVE_s = 30  # a gateway's firewall forgets connections on which nothing moves


def fingerprint(key: paramiko.PKey) -> str:
    """Fingerprint of a host key as OpenSSH prints it."""
    digest = hashlib.sha256(key.asbytes()).digest()
    return "SHA256:" + base64.b64encode(digest).decode().rstrip("=")


class _RefuseUnknown(paramiko.MissingHostKeyPolicy):
    """Refuses a host that nobody has trusted yet, and says how to trust it."""

    def __init__(self, endpoint: Endpoint, known_hosts: Path) -> None:
        self._endpoint = endpoint
        self._known_hosts = known_hosts

    def missing_host_key(
        self, client: paramiko.SSHClient, hostname: str, key: paramiko.PKey
    ) -> None:
        """Raise ``HostKeyRefused``."""
        del client
        missing = "" if self._known_hosts.exists() else " (the file does not exist)"
        raise HostKeyRefused(
            f"the host key of {hostname} is not in {self._known_hosts}{missing}: "
            f"{key.get_name()} {fingerprint(key)}",
            hint="Compare this fingerprint with the one the gateway's owner gives you, then trust "
            f"it with: ssh-keyscan -p {self._endpoint.port} {self._endpoint.host} "
            f">> {self._known_hosts}",
            context={"fingerprint": fingerprint(key)},
        )


class TunnelTransport(SocketTransport):
    """A tunnel through a gateway; closing it also ends the login."""

    def __init__(
        self, client: paramiko.SSHClient, channel: paramiko.Channel, endpoint: Endpoint
    ) -> None:
        super().__init__(channel, endpoint.name, endpoint.framing)
        self._client = client

    def close(self) -> None:
        """Close the channel and the login."""
        super().close()
        self._client.close()


def open_tunnel(endpoint: Endpoint, deadline: Deadline) -> TunnelTransport:
    """Log in to the gateway and open a channel to the controller behind it.

    Raises
    ------
    HostKeyRefused
        If the gateway's key is unknown or has changed.
    ConnectFailed
        If the gateway or the controller behind it cannot be reached, or refuses the login.
    """
    client = login(endpoint, deadline)
    transport = client.get_transport()
    target = (endpoint.target_host, endpoint.target_port)
    try:
        if transport is None:
            raise paramiko.SSHException("the login has ended")  # noqa: TRY301
        transport.set_keepalive(_KEEPALIVE_s)
        channel = transport.open_channel(
            "direct-tcpip", target, ("127.0.0.1", 0), timeout=_time_left_s(deadline)
        )
    except (paramiko.SSHException, OSError) as error:
        client.close()
        raise ConnectFailed(
            f"the gateway {endpoint.host} does not reach {target[0]}:{target[1]}: {error}",
            hint="Check the controller's address as the gateway sees it, and that the gateway "
            "allows forwarding.",
        ) from error
    return TunnelTransport(client, channel, endpoint)


def login(endpoint: Endpoint, deadline: Deadline) -> paramiko.SSHClient:
    """A logged-in SSH client.

    Raises
    ------
    HostKeyRefused
        If the host's key is unknown or has changed.
    ConnectFailed
        If there is no connection or no login.
    ConfigError
        If the options of the address cannot be met.
    """
    known_hosts = Path(endpoint.options.get("known_hosts", DEFAULT_KNOWN_HOSTS)).expanduser()
    client = paramiko.SSHClient()
    try:
        if known_hosts.exists():
            _trust(client.get_host_keys(), known_hosts)
        client.set_missing_host_key_policy(_RefuseUnknown(endpoint, known_hosts))
        _connect(client, endpoint, deadline, known_hosts)
    except BaseException:
        client.close()
        raise
    return client


def _trust(keys: paramiko.HostKeys, known_hosts: Path) -> None:
    """Take the host keys of a file; lines that are none are passed over, as OpenSSH does."""
    for line in known_hosts.read_bytes().decode("utf-8", "replace").splitlines():
        if not line.strip() or line.lstrip().startswith(("#", "@")):
            continue  # @revoked and @cert-authority: keys that nobody trusts as they stand
        try:
            entry = paramiko.hostkeys.HostKeyEntry.from_line(line)
        except (paramiko.SSHException, paramiko.hostkeys.InvalidHostKey, ValueError):
            continue
        if entry is None or entry.key is None:
            continue
        for name in entry.hostnames or ():
            if entry.key.get_name() not in (keys.lookup(name) or {}):
                keys.add(name, entry.key.get_name(), entry.key)


def _connect(
    client: paramiko.SSHClient, endpoint: Endpoint, deadline: Deadline, known_hosts: Path
) -> None:
    options = endpoint.options
    left_s = _time_left_s(deadline)
    password = _password(options.get("password_env"))
    try:
        client.connect(
            endpoint.host,
            endpoint.port,
            endpoint.user or None,
            password=password,
            key_filename=_identity(options.get("identity"), password),
            # Agent and keys of the user's folder are offered only where the address asks for them.
            allow_agent=endpoint.option_flag("agent", default=False),
            look_for_keys=False,
            timeout=left_s,
            banner_timeout=left_s,
            auth_timeout=left_s,
        )
    except paramiko.BadHostKeyException as error:
        raise _changed_key(endpoint, error, known_hosts) from error
    except paramiko.AuthenticationException as error:
        raise ConnectFailed(
            f"{endpoint.host} refuses the login of '{endpoint.user}'",
            hint="Give a way to log in: ?identity=FILE, ?agent=yes or ?password_env=NAME.",
        ) from error
    except socket.gaierror as error:
        raise ConnectFailed(
            f"the name '{endpoint.host}' is not known: {error.strerror}",
            hint="Check the spelling of the gateway, or use its address.",
        ) from error
    except (paramiko.SSHException, OSError, EOFError) as error:
        reason = getattr(error, "strerror", None) or error
        # paramiko's word for an address that names no way to log in (it tried none).
        if str(error).startswith("No authentication methods"):
            raise ConnectFailed(
                f"no way to log in to {endpoint.host} as '{endpoint.user}' is named",
                hint="Give one: ?identity=FILE, ?agent=yes or ?password_env=NAME.",
            ) from error
        raise ConnectFailed(
            f"no SSH connection to {endpoint.host}:{endpoint.port}: {reason}",
            hint="Check the gateway's address and that its SSH server runs.",
        ) from error


def _changed_key(
    endpoint: Endpoint, error: paramiko.BadHostKeyException, known_hosts: Path
) -> HostKeyRefused:
    host = endpoint.host if endpoint.port == 22 else f"[{endpoint.host}]:{endpoint.port}"
    return HostKeyRefused(
        f"the host key of {endpoint.host} has CHANGED: it is now {error.key.get_name()} "
        f"{fingerprint(error.key)}, not {fingerprint(error.expected_key)}",
        hint="Somebody may be in between. If the gateway was really reinstalled, forget its old "
        f"key with: ssh-keygen -f {known_hosts} -R '{host}'",
        context={"fingerprint": fingerprint(error.key)},
    )


def _password(variable: str | None) -> str | None:
    if variable is None:
        return None
    try:
        return os.environ[variable]
    except KeyError as error:
        raise ConfigError(
            f"the environment variable {variable} is not set",
            code="PC-URL-003",
            hint="?password_env= names the variable that holds the password; export it first.",
        ) from error


def _identity(file_name: str | None, password: str | None) -> str | None:
    if file_name is None:
        return None
    path = Path(file_name).expanduser()
    if not path.is_file():
        raise ConfigError(
            f"there is no key file {path}",
            code="PC-URL-004",
            hint="?identity= names the private key, for example ~/.ssh/id_ed25519.",
        )
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise ConfigError(
            f"others can read the key file {path}",
            code="PC-URL-004",
            hint=f"Protect it with: chmod 600 {path}",
        )
    try:
        phrase = None if password is None else password.encode()
        paramiko.PKey.from_path(path, phrase)  # type: ignore[arg-type]  # it takes bytes only
    except TypeError as error:  # as cryptography says that it is protected
        raise ConfigError(
            f"the key file {path} is protected by a passphrase",
            code="PC-URL-006",
            hint="Put it into ssh-agent and give ?agent=yes, or name with ?password_env= the "
            "variable that holds the passphrase.",
        ) from error
    except (ValueError, OSError, paramiko.SSHException, paramiko.pkey.UnknownKeyType) as error:
        raise ConfigError(
            f"{path} is no private key, or its passphrase is another one",
            code="PC-URL-007",
            hint="?identity= names the private key (not the .pub beside it), in the form of "
            "OpenSSH or PEM.",
        ) from error
    return str(path)


def _time_left_s(deadline: Deadline) -> float:
    return max(_SHORTEST_WAIT_s, deadline.remaining_s())
