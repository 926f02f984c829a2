"""Serial line to a controller's ASCII port."""

import serial

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import ConfigError, ConnectFailed, LinkLost, ReplyTimeout
from pmac_comp.machine.transport.base import Framing

DEFAULT_BAUD = 38400
_POLL_s = 0.02
_PARITIES = {"N": serial.PARITY_NONE, "E": serial.PARITY_EVEN, "O": serial.PARITY_ODD}


class SerialTransport:
    """Bytes over a serial device that nobody else has open.

    The device is read in short slices, so that the deadline holds for the whole wait and not
    from byte to byte.

    Parameters
    ----------
    device : str
        Device name, e.g. ``/dev/ttyS0``.
    baud : int
        Bits per second (I54 = 12 is 38400).
    parity : str
        ``N``, ``E`` or ``O``.
    rtscts : bool
        Hardware handshake.
    """

    def __init__(
        self, device: str, *, baud: int = DEFAULT_BAUD, parity: str = "N", rtscts: bool = False
    ) -> None:
        if parity not in _PARITIES:
            raise ConfigError(
                f"parity={parity} is none of N, E, O",
                code="PC-URL-002",
                hint="N is none, E even, O odd; without ?parity= it is none.",
            )
        self._name = f"serial://{device}"
        try:
            self._port = serial.Serial(
                device,
                baudrate=baud,
                parity=_PARITIES[parity],
                rtscts=rtscts,
                timeout=_POLL_s,
                write_timeout=5.0,
                exclusive=True,
            )
        except (serial.SerialException, ValueError, OSError) as error:
            raise ConnectFailed(
                f"{self._name} cannot be opened: {error}",
                hint="Check the device name, your rights on it, and that no other program has it.",
            ) from error

    @property
    def name(self) -> str:
        """Where it leads."""
        return self._name

    @property
    def framing(self) -> Framing:
        """Always lines."""
        return Framing.LINES

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send all bytes."""
        if deadline.expired():
            raise ReplyTimeout(f"{self._name} had no time left to send")
        try:
            self._port.write(data)
        except serial.SerialTimeoutException as error:
            raise ReplyTimeout(f"{self._name} does not take what is sent") from error
        except (serial.SerialException, OSError, TypeError) as error:
            raise self._lost(error) from error

    def receive(self, deadline: Deadline) -> bytes:
        """At least one byte before the deadline."""
        while True:
            data = self._take(1)
            if data:
                return data + self.drain()
            if deadline.expired():
                raise ReplyTimeout(f"{self._name} did not answer in time")

    def drain(self) -> bytes:
        """Take what has arrived."""
        try:
            waiting = self._port.in_waiting
        except (serial.SerialException, OSError, TypeError) as error:
            raise self._lost(error) from error
        return self._take(waiting) if waiting else b""

    def _take(self, size: int) -> bytes:
        try:
            return bytes(self._port.read(size))
        except (serial.SerialException, OSError, TypeError) as error:
            raise self._lost(error) from error

    def renew(self) -> None:
        """Nothing: a stream keeps its order, so a mark in it can be found."""

    def close(self) -> None:
        """Close the device."""
        self._port.close()

    def _lost(self, error: Exception) -> LinkLost:
        # pyserial answers a read on a closed port with TypeError.
        self._port.close()
        return LinkLost(f"{self._name} was lost: {error}", hint="Check the cable.")
