"""pmac-motorhome, unmodified: a homing PLC of every type made, expanded, downloaded and run.

Arguments: host, port, folder. One case per homing type and per move after homing; the settings are
what the type's own description asks for (direction of Ixx23, capture edge and flag of I7mn2/3).
"""

import json
import sys
import time
from pathlib import Path

from dls_pmaclib.dls_pmacremote import PmacEthernetInterface
from dls_pmaclib.dls_pmcpreprocessor import ClsPmacParser
from pmac_motorhome import sequences
from pmac_motorhome.commands import ControllerType, group, motor, plc
from pmac_motorhome.constants import PostHomeMove as Post

SWITCH = "i123=-50 i7012=2 i7013=0"
CASES = {
    "hsw": ("home_hsw", SWITCH, {}),
    "hsw_index": ("home_hsw", "i123=-50 i7012=1 i7013=0", {"jdist": 1000}),
    "hsw_from_the_other_side": ("home_hsw", "i123=50 i7012=10 i7013=0", {"start": "low"}),
    "hsw_hlim": ("home_hsw_hlim", SWITCH, {}),
    "hsw_dir_off_switch": ("home_hsw_dir", SWITCH, {}),
    "hsw_dir_on_switch": ("home_hsw_dir", SWITCH, {"start": "low"}),
    "hsw_hstop": (
        "home_hsw_hstop",
        "i123=50 i7012=10 i7013=0 i124=$20001 i112=8000 i111=64000 i122=20",
        {},
    ),
    "limit_negative": ("home_limit", "i123=-50 i7012=2 i7013=2", {}),
    "limit_positive": ("home_limit", "i123=50 i7012=2 i7013=1", {}),
    "rlim_negative": ("home_rlim", "i123=50 i7012=10 i7013=2", {}),
    "rlim_positive": ("home_rlim", "i123=-50 i7012=10 i7013=1", {}),
    "rlim_index": ("home_rlim", "i123=50 i7012=1 i7013=0", {"jdist": 1000}),
    "home": ("home_home", SWITCH, {}),
    "post_initial": ("home_hsw", SWITCH, {"post": Post.initial_position}),
    "post_high": (
        "home_hsw", SWITCH + " i113=200000 i114=-5000", {"post": Post.high_limit}
    ),
    "post_low": ("home_hsw", SWITCH + " i113=200000 i114=-5000", {"post": Post.low_limit}),
    "post_hard_high": ("home_hsw", SWITCH, {"post": Post.hard_hi_limit}),
    "post_hard_low": ("home_hsw", SWITCH, {"post": Post.hard_lo_limit}),
    "post_relative": ("home_hsw", SWITCH, {"post": Post.relative_move, "distance": 5000}),
    "post_zero_there": ("home_hsw", SWITCH, {"post": Post.move_and_hmz, "distance": 5000}),
    "post_absolute": ("home_hsw", SWITCH, {"post": Post.move_absolute, "distance": 7000}),
}  # fmt: skip
NEUTRAL = (
    "disable plc 11",
    "#1k",
    "i5=2 i124=1 i113=0 i114=0 i126=0 i122=100 i197=0 i111=32000 i112=16000",
    "i7012=2 i7013=0",
    "#1j/",
)
DONE, RUNNING = "7", ("0", "1")

host, port, folder = sys.argv[1:4]
pmac = PmacEthernetInterface(verbose=False)
pmac.setConnectionParams(host, port)
pmac.connect()


def ask(command):
    return pmac.sendCommand(command)[0].rstrip("\x06").rstrip("\r").split("\r")


def settle(command):
    ask(command)
    end = time.monotonic() + 20
    time.sleep(0.02)
    while time.monotonic() < end:
        status = int(ask("#1?")[0], 16)
        if status & 1 and not status >> 41 & 1:
            return float(ask("#1p")[0])
        time.sleep(0.01)
    raise TimeoutError(command)


def home(name, sequence, settings, options):
    path = Path(folder) / f"{name}.pmc"
    after = {"post_home": options.get("post", Post.none)}
    after["post_distance"] = options.get("distance", 0)
    with (
        plc(plc_num=11, controller=ControllerType.brick, filepath=path),
        group(group_num=2, **after),
    ):
        motor(axis=1, jdist=options.get("jdist", -400))
        getattr(sequences, sequence)()
    for command in NEUTRAL:
        ask(command)
    high, low = settle("#1j+"), settle("#1j-")
    start = low if options.get("start") else settle(f"#1j={(high + low) / 2:.0f}")
    ask(settings)
    text = ClsPmacParser().parse(str(path))
    lines = [(number, line) for number, line in enumerate(text, start=1) if line.strip()]
    refused = [[c, answer] for _, _, c, answer in pmac.sendSeries(lines) if "ERR" in answer]
    ask("p1102=2 enable plc 11")
    states = []
    end = time.monotonic() + 30
    while time.monotonic() < end:
        state, status = ask("p1100 p1101")
        states.append(state)
        if state == DONE or status not in RUNNING:
            break
        time.sleep(0.01)
    return {
        "refused": refused,
        "state": state,
        "status": status,
        "states": sorted(set(states)),
        "homed": ask("m145")[0],
        "position": float(ask("#1p")[0]),
        "start": start,
        "limits": [low, high],
    }


print(json.dumps({name: home(name, *case) for name, case in CASES.items()}))
pmac.disconnect()
