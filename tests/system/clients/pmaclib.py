"""dls-pmaclib, unmodified: arguments ethernet|telnet|serial, host or device, port or baud rate."""

import json
import sys
import time

from dls_pmaclib import dls_pmacremote as remote

kind, host, port = sys.argv[1:4]
classes = {
    "ethernet": remote.PmacEthernetInterface,
    "telnet": remote.PmacTelnetInterface,
    "serial": remote.PmacSerialInterface,
}
if kind == "serial":
    # The released class gives str to pyserial and compares the bytes it reads with str, so it can
    # neither send nor see an ACK on Python 3; these two classes bridge just that.
    import serial

    class Character(bytes):
        __hash__ = bytes.__hash__

        def __eq__(self, other):
            return self.decode("latin-1") == other

        def __ne__(self, other):
            return not self == other

    class TextSerial(serial.Serial):
        def write(self, data):
            return super().write(data.encode("latin-1") if isinstance(data, str) else data)

        def read(self, size=1):
            return Character(super().read(size))

    remote.serial.Serial = TextSerial
pmac = classes[kind](verbose=False, timeout=3)
pmac.setConnectionParams(host, port)
result = {"connect": pmac.connect()}


def ask(command):
    return pmac.sendCommand(command)


for command in ("ver", "cid", "i130", "i102", "#1?", "nonsense", "i100..131", "m162->"):
    result[command] = ask(command)
ask("p5=3.25")
result["p5"] = ask("p5")
ask("m500->y:$10f0,0,8")
ask("m500=200")
result["m500"] = ask("m500")
ask("i122=77")
result["i122"] = ask("i122")
ask("#1j/")
ask("#1j=12345")
for _ in range(100):
    time.sleep(0.05)
    if ask("m140")[0].startswith("1"):
        break
result["position"] = ask("#1p")[0]
if kind == "ethernet":
    result["axes"] = pmac.getNumberOfAxes()
    result["model"] = pmac.getPmacModel()
    result["series"] = [
        [ok, line, command, answer]
        for ok, line, command, answer in pmac.sendSeries(
            [(1, "OPEN PLC 9 CLEAR"), (2, "P1=P1+1"), (3, "BAD LINE"), (4, "CLOSE")]
        )
    ]
    result["listing"] = ask("list plc 9")[0]
    result["save"] = ask("save")
pmac.disconnect()
print(json.dumps(result))
