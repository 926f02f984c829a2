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


def moved_to(target):
    for _ in range(200):
        time.sleep(0.02)
        if abs(float(ask("#1p")[0].split("\r")[0]) - target) < 3:
            break
    return float(ask("#1p")[0].split("\r")[0]) - target


# Every method of the interface that a Turbo PMAC without MACRO can serve.
result["axes"] = pmac.getNumberOfAxes()
result["model"] = [pmac.getPmacModel(), pmac.getShortModelName(), pmac.getPmacModelCode()]
result["geobrick"] = [pmac.isModelGeobrick(), pmac.isMacroStationAxis(1)]
pmac.setVar("p6", 12.5)
result["ivars"] = pmac.getIVars(100, [2, 3, 30])
pmac.setAxisSetupIVar(1, 22, 80)
result["setup"] = pmac.getAxisSetupIVars(1, [22, 24])
pmac.setOnboardAxisI7000PlusIVar(2, 3, 1)
result["onboard"] = pmac.getOnboardAxisI7000PlusVars(2, [2, 3])
result["to"] = [pmac.jogTo(1, 3000)[1], moved_to(3000)]
result["inc"] = [pmac.jogInc(1, "pos", 500)[1], moved_to(3500)]
result["dec"] = [pmac.jogInc(1, "neg", 500)[1], moved_to(3000)]
result["continuous"] = [pmac.jogContinous(1, "neg")[1], pmac.jogStop(1)[1]]
result["limits"] = [
    pmac.disableLimits(1, disable=False),
    ask("i124"),
    pmac.disableLimits(1, disable=True),
]
result["home"] = pmac.homeCommand(1)[1]
ask("#1k")
result["series"] = [
    [ok, line, command, answer]
    for ok, line, command, answer in pmac.sendSeries(
        [(1, "OPEN PLC 9 CLEAR"), (2, "P1=P1+1"), (3, "BAD LINE"), (4, "CLOSE")]
    )
]
result["listing"] = ask("list plc 9")[0]
cancelled = pmac.sendSeries([(1, "p7=1"), (2, "p7=2"), (3, "p7=3")])
next(cancelled)
cancelled.close()
result["cancelled"] = ask("p7")[0]
result["save"] = ask("save")
pmac.disconnect()
pmac.connect()
result["again"] = ask("p6")[0]
pmac.disconnect()
print(json.dumps(result))
