"""dls-backup-bl, unmodified: positions saved and put back. Arguments: host, port, folder."""

import json
import sys
from pathlib import Path

from dls_backup_bl.brick import Brick
from dls_backup_bl.defaults import Defaults
from dls_pmaclib.dls_pmacremote import PmacEthernetInterface

host, port, folder = sys.argv[1:4]
defaults = Defaults(domain="bench", backup_folder=Path(folder), retries=1)
defaults.motion_folder.mkdir(parents=True, exist_ok=True)
brick = Brick("bench", host, int(port), t_serv=False, defaults=defaults)


def ask(command):
    pmac = PmacEthernetInterface(verbose=False)
    pmac.setConnectionParams(host, port)
    pmac.connect()
    answer = pmac.sendCommand(command)[0]
    pmac.disconnect()
    return answer


brick.backup_controller()
ask("#1k m161=1234*32*i108 m162=1234*32*i108")
brick.backup_positions()
ask("#1k m161=0 m162=0")
moved = ask("m162")
brick.restore_positions()
print(
    json.dumps(
        {
            "moved": moved,
            "restored": ask("m162"),
            "positions": (defaults.motion_folder / "bench_positions.pmc").read_text(),
            "configuration": (defaults.motion_folder / "bench.pmc").stat().st_size,
        }
    )
)
