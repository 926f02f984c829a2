"""Connection addresses: one URL for every way to reach a controller.

``tcp://host[:1025]``, ``udp://host[:1025]``, ``serial:///dev/ttyS0?baud=38400``,
``ssh://user@gateway/pmac-host:1025``, ``gpascii://user@host``, ``sim://``. The option
``?dialog=ascii`` makes a TCP address an ASCII port, as behind a terminal server; ``?record=FILE``
keeps every byte of the session in a file.
"""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import parse_qsl, unquote, urlsplit

from pmac_comp.base.errors import ConfigError
from pmac_comp.machine.transport.base import Framing

PACKET_PORT = 1025
SSH_PORT = 22
_HERE = {"localhost": "127.0.0.1", "::1": "127.0.0.1"}
_EXAMPLES = {
    "sim": "sim://",
    "tcp": "tcp://192.6.94.5",
    "udp": "udp://192.6.94.5",
    "serial": "serial:///dev/ttyS0?baud=38400",
    "ssh": "ssh://user@gateway/192.6.94.5:1025",
    "gpascii": "gpascii://root@192.168.0.200",
}
_SSH_OPTIONS = frozenset({"known_hosts", "identity", "agent", "password_env"})
_OPTIONS: dict[str, frozenset[str]] = {
    "sim": frozenset(),
    "tcp": frozenset({"dialog", "record"}),
    "udp": frozenset({"record"}),
    "serial": frozenset({"baud", "parity", "rtscts", "checksum", "record"}),
    "ssh": _SSH_OPTIONS | {"dialog", "record"},
    "gpascii": _SSH_OPTIONS,
}


@dataclass(frozen=True)
class Endpoint:
    """A parsed connection address.

    Parameters
    ----------
    scheme : str
        One of ``sim tcp udp serial ssh gpascii``.
    host : str
        Machine to connect to: the controller, or the gateway for ``ssh``.
    port : int
        Port on that machine.
    user : str
        Login name for ``ssh`` and ``gpascii``.
    device : str
        Serial device.
    target_host, target_port : str, int
        The controller as the gateway sees it.
    options : Mapping of str to str
        What stood behind the question mark.
    """

    scheme: str
    host: str = ""
    port: int = 0
    user: str = ""
    device: str = ""
    target_host: str = ""
    target_port: int = 0
    options: Mapping[str, str] = field(default_factory=dict)

    @property
    def framing(self) -> Framing:
        """Packet port, unless serial or asked for as an ASCII port."""
        ascii_port = self.scheme == "serial" or self.options.get("dialog") == "ascii"
        return Framing.LINES if ascii_port else Framing.PACKETS

    @property
    def name(self) -> str:
        """The address without its options, for messages."""
        if self.scheme == "serial":
            return f"serial://{self.device}"
        login = f"{self.user}@" if self.user else ""
        place = f"{self.scheme}://{login}{self.host}" + (f":{self.port}" if self.port else "")
        return f"{place}/{self.target_host}:{self.target_port}" if self.target_host else place

    def option_int(self, key: str, default: int) -> int:
        """Value of a whole-number option."""
        text = self.options.get(key, str(default))
        if not text.isdecimal():
            raise _wrong(f"{key}={text} in the address is no whole number", self.scheme)
        return int(text)

    def option_flag(self, key: str, *, default: bool) -> bool:
        """Value of a yes/no option."""
        text = self.options.get(key, "yes" if default else "no").lower()
        if text not in {"yes", "no", "1", "0", "true", "false"}:
            raise _wrong(f"{key}={text} in the address is neither yes nor no", self.scheme)
        return text in {"yes", "1", "true"}


def card_address(url: str) -> str:
    """Address of a card, the same for all URLs that name it by the same host and port, or device.

    Names are not looked up: a host by its name and by its number counts as two.
    """
    endpoint = parse_url(url)
    if endpoint.device:
        return str(Path(endpoint.device).resolve())
    host = endpoint.target_host or endpoint.host
    return f"{_HERE.get(host, host)}:{endpoint.target_port or endpoint.port}"


def _wrong(message: str, scheme: str = "", *, hint: str = "") -> ConfigError:
    """Error of an address, with the form that its scheme has where nothing better is said."""
    example = _EXAMPLES.get(scheme, "tcp://192.6.94.5:1025")
    return ConfigError(message, code="PC-URL-001", hint=hint or f"For example {example}.")


def parse_url(url: str) -> Endpoint:
    """Parts of a connection address.

    Raises
    ------
    ConfigError
        With an example of the form that was probably meant.
    """
    scheme, separator, _ = url.partition("://")
    scheme = scheme.lower()
    if not separator or scheme not in _EXAMPLES:
        raise _wrong(_unknown_scheme(url, scheme), hint=_hint_all())
    parts = urlsplit(url)
    if parts.password is not None:
        raise _wrong(
            "an address never holds a password: it would end up in histories and logs",
            hint="Use ?identity=FILE, ?agent=yes or ?password_env=NAME.",
        )
    options = _read_options(scheme, parts.query)
    port = _port(url, parts.netloc)
    return _BUILDERS[scheme](parts.hostname or "", port, parts.username or "", parts.path, options)


def _unknown_scheme(url: str, scheme: str) -> str:
    if "://" not in url:
        return f"'{url}' is no connection address: it has no scheme"
    near = difflib.get_close_matches(scheme, _EXAMPLES, n=1)
    return f"unknown scheme '{scheme}'" + (f"; did you mean '{near[0]}'?" if near else "")


def _hint_all() -> str:
    return "Known forms: " + ", ".join(_EXAMPLES.values())


def _read_options(scheme: str, query: str) -> dict[str, str]:
    options = dict(parse_qsl(query, keep_blank_values=True))
    for key in options:
        if key not in _OPTIONS[scheme]:
            known = ", ".join(sorted(_OPTIONS[scheme])) or "none"
            raise _wrong(f"{scheme}:// knows no option '{key}'", hint=f"Known: {known}.")
    if options.get("dialog", "ascii") not in {"ascii", "packets"}:
        raise _wrong(
            f"dialog={options['dialog']} is neither ascii nor packets",
            hint="?dialog=ascii is a terminal server; packets is the controller's own port.",
        )
    return options


def _port(url: str, netloc: str) -> int:
    try:
        return urlsplit(url).port or 0
    except ValueError as error:
        scheme = url.partition("://")[0].lower()
        raise _wrong(f"'{netloc}' has no valid port: 1 to 65535", scheme) from error


def _require_host(scheme: str, host: str) -> None:
    if not host:
        raise _wrong(f"{scheme}:// needs a host", scheme)


def _no_path(scheme: str, path: str) -> None:
    if path not in {"", "/"}:
        raise _wrong(f"{scheme}:// takes no path, but '{path}' was given", scheme)


def _sim(host: str, port: int, user: str, path: str, options: dict[str, str]) -> Endpoint:
    if host or port or user or path not in {"", "/"}:
        raise _wrong(
            "sim:// is the embedded simulated PMAC and takes no host or path",
            hint="Write sim:// alone; one that `pmac-comp sim --tcp` serves is tcp://127.0.0.1:PORT.",
        )
    return Endpoint("sim", options=options)


def _tcp(host: str, port: int, user: str, path: str, options: dict[str, str]) -> Endpoint:
    return _network("tcp", host, port, user, path, options)


def _udp(host: str, port: int, user: str, path: str, options: dict[str, str]) -> Endpoint:
    return _network("udp", host, port, user, path, options)


def _network(
    scheme: str, host: str, port: int, user: str, path: str, options: dict[str, str]
) -> Endpoint:
    _require_host(scheme, host)
    _no_path(scheme, path)
    if user:
        raise _wrong(f"{scheme}:// has no login, but '{user}@' was given", scheme)
    return Endpoint(scheme, host, port or PACKET_PORT, options=options)


def _serial(host: str, port: int, user: str, path: str, options: dict[str, str]) -> Endpoint:
    if user or port:
        raise _wrong("serial:// takes a device only", "serial")
    # serial://COM3 puts the Windows name where others have a host
    device = unquote(path) if not host else host.upper() + unquote(path)
    if not device or device == "/":
        raise _wrong("serial:// needs a device", "serial")
    return Endpoint("serial", device=device, options=options)


def _ssh(host: str, port: int, user: str, path: str, options: dict[str, str]) -> Endpoint:
    _require_host("ssh", host)
    target = urlsplit(f"//{path.lstrip('/')}")
    if not target.hostname or target.path:
        raise _wrong("ssh:// needs the controller behind the gateway", "ssh")
    target_port = _port(f"//{path.lstrip('/')}", path)
    return Endpoint(
        "ssh",
        host,
        port or SSH_PORT,
        user,
        target_host=target.hostname,
        target_port=target_port or PACKET_PORT,
        options=options,
    )


def _gpascii(host: str, port: int, user: str, path: str, options: dict[str, str]) -> Endpoint:
    _require_host("gpascii", host)
    _no_path("gpascii", path)
    return Endpoint("gpascii", host, port or SSH_PORT, user, options=options)


_BUILDERS = {
    "sim": _sim,
    "tcp": _tcp,
    "udp": _udp,
    "serial": _serial,
    "ssh": _ssh,
    "gpascii": _gpascii,
}
