"""pmac-motorhome, unmodified: its homing PLC made, expanded, downloaded and run.

Arguments: host, port, folder, sequence.
"""

import json
import sys
import time
from pathlib import Path

from dls_pmaclib.dls_pmacremote import PmacEthernetInterface
from dls_pmaclib.dls_pmcpreprocessor import ClsPmacParser
from pmac_motorhome import sequences
from pmac_motorhome.commands import ControllerType, group, motor, plc

host, port, folder, sequence = sys.argv[1:5]
path = Path(folder) / "homing.pmc"
with plc(plc_num=11, controller=ControllerType.brick, filepath=path), group(group_num=2):
    motor(axis=1, jdist=-400)
    getattr(sequences, sequence)()

text = ClsPmacParser().parse(str(path))
lines = [(number, line) for number, line in enumerate(text, start=1) if line.strip()]
pmac = PmacEthernetInterface(verbose=False)
pmac.setConnectionParams(host, port)
pmac.connect()
refused = [
    [command, answer] for ok, _line, command, answer in pmac.sendSeries(lines) if "ERR" in answer
]
for command in (
    "i5=2",
    "i124=1 i113=0 i114=0",
    "i123=-50",
    "i7012=2",
    "i7013=0",
    "#1j/",
    "p1102=2",
    "enable plc 11",
):
    pmac.sendCommand(command)
states = []
for _ in range(600):
    time.sleep(0.05)
    states.append(pmac.sendCommand("p1100 p1101")[0])
    if states[-1].split("\r")[0] == "7":
        break
print(
    json.dumps(
        {
            "lines": len(lines),
            "refused": refused,
            "states": sorted(set(states)),
            "last": states[-1],
            "homed": pmac.sendCommand("m145")[0],
            "position": pmac.sendCommand("#1p")[0],
        }
    )
)
pmac.disconnect()
