"""From a connection address to a connected transport."""

from pathlib import Path

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import ConfigError
from pmac_comp.machine.transport.base import Transport
from pmac_comp.machine.transport.record import RecordingTransport
from pmac_comp.machine.transport.serial_port import DEFAULT_BAUD, SerialTransport
from pmac_comp.machine.transport.tcp import open_tcp
from pmac_comp.machine.transport.udp import UdpTransport
from pmac_comp.machine.transport.url import Endpoint, parse_url


def open_transport(url: str | Endpoint, deadline: Deadline) -> Transport:
    """A connected transport for an address.

    Parameters
    ----------
    url : str or Endpoint
        Connection address.
    deadline : Deadline
        Until when it must be connected.

    Raises
    ------
    ConfigError
        If the address is not understood, or names ``sim://`` or ``gpascii://``, which are not
        streams to a Turbo PMAC.
    ConnectFailed, HostKeyRefused
        If there is no connection.
    """
    endpoint = parse_url(url) if isinstance(url, str) else url
    transport = _connect(endpoint, deadline)
    if "record" in endpoint.options:
        return RecordingTransport(transport, Path(endpoint.options["record"]), deadline.clock)
    return transport


def _connect(endpoint: Endpoint, deadline: Deadline) -> Transport:
    if endpoint.scheme == "tcp":
        return open_tcp(endpoint.host, endpoint.port, deadline, endpoint.framing)
    if endpoint.scheme == "udp":
        return UdpTransport(endpoint.host, endpoint.port)
    if endpoint.scheme == "serial":
        return SerialTransport(
            endpoint.device,
            baud=endpoint.option_int("baud", DEFAULT_BAUD),
            parity=endpoint.options.get("parity", "N").upper(),
            rtscts=endpoint.option_flag("rtscts", default=False),
        )
    if endpoint.scheme == "ssh":
        # Imported here: paramiko takes longer to load than all the rest together.
        from pmac_comp.machine.transport.ssh import open_tunnel

        return open_tunnel(endpoint, deadline)
    if endpoint.scheme == "gpascii":
        raise ConfigError(
            "gpascii:// leads to a Power PMAC, which only 'info' and 'terminal' support",
            hint="There was no Power PMAC to test more on; use a Turbo PMAC's address.",
        )
    raise ConfigError("sim:// is opened together with the simulated card, not as a connection")
