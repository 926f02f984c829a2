"""dls-pmaccontrol, unmodified, without a screen: its windows polled and each of their buttons used.

Arguments: host, port, folder.
"""

import json
import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from PyQt5.QtWidgets import QApplication, QFileDialog, QMessageBox

host, port, folder = sys.argv[1:4]
app = QApplication([])
problems = []
for name in ("information", "warning", "critical"):
    setattr(QMessageBox, name, lambda *arguments: problems.append(str(arguments[1:3])))

from dls_pmac_control.__main__ import Controlform  # noqa: E402

options = SimpleNamespace(
    protocol="tcpip", server=host, port=port, defaultAxis=1, nAxes=None,
    macroAxisStartIndex=0, username="", password="", verbose=False, timeout=3,
)  # fmt: skip
window = Controlform(options)
result = {}


def pump(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        app.processEvents()
        time.sleep(0.01)


def wait(condition, seconds=8.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        pump(0.05)
    return condition()


def ask(command):
    return window.pmac.sendCommand(command)[0].rstrip("\x06").rstrip("\r")


def position():
    return float(ask("#1p"))


def lit(form):
    return [
        label.text()
        for led, label in zip(form.lstLeds, form.lstLabels, strict=False)
        if led.pixmap().cacheKey() == form.greenLedOn.cacheKey()
    ]


window.remoteConnect()
wait(
    lambda: window.table.item(0, 0) is not None and window.table.item(0, 0).text() not in ("", "-")
)
result["polled"] = window.table.item(0, 0).text()
result["rows"] = window.table.rowCount()

# Jog ribbon.
window.spnJogMotor.setValue(1)
window.jogStop()
start = position()
window.lneJogDist.setText("1500")
window.jogPos()
wait(lambda: abs(position() - start - 1500) < 3)
result["jog_positive"] = position() - start
window.jogNeg()
wait(lambda: abs(position() - start) < 3)
result["jog_negative"] = position() - start
window.jogPosContinousStart()
pump(0.3)
window.jogStop()
pump(0.5)
result["jog_continuous"] = position() - start
window.lneJogTo.setText("2500")
window.jogGoToPosition()
wait(lambda: abs(position() - 2500) < 3)
result["jog_to"] = position()
window.jogHome()
pump(0.2)
result["homing_bit"] = int(ask("#1?")[3], 16) >> 2 & 1
window.jogStop()
pump(0.5)
window.killMotor()
pump(0.2)
result["killed"] = ask("#1?")
window.jogStop()
window.killAllMotors()
pump(0.2)
result["all_killed"] = ask("#1?")

# Status windows.
form = window.statusScreen
form.show()
window.CSStatusScreen.show()
window.GlobalStatusScreen.show()
pump(0.5)
for key, screen in (
    ("motor", form),
    ("cs", window.CSStatusScreen),
    ("global", window.GlobalStatusScreen),
):
    result[f"lit_{key}"] = lit(screen)
window.CSStatusScreen.updateFeed(100)
window.CSStatusScreen.setFeed(50)
pump(0.4)
result["feed"] = ask("&1%")
window.CSStatusScreen.setFeed(100)

# Watches.
window.watches()
watches = window.watchesScreen
for variable in ("P77", "I130", "#1?"):
    watches.lneVariableName.setText(variable)
    watches.addWatch()
pump(0.8)
result["watches"] = [
    [watches.table.item(row, 0).text(), watches.table.item(row, 1).text()]
    for row in range(watches.table.rowCount())
]
watches.table.setCurrentCell(0, 0)
watches.lneEditValue.setText("3.25")
watches.applyEditWatch()
pump(0.3)
result["watch_edited"] = ask("p77")
watches.clearWatches()

# Axis settings.
window.jogParameters()
settings = window.axisSettingsScreen
result["settings"] = {n: getattr(settings, f"lneIx{n}").text() for n in (30, 31, 32, 33)}
settings.lneIx22.setText("44")
settings.sendIx22()
result["i122"] = ask("i122")

# Energise window.
window.pmacEnergiseAxis()
window.energiseScreen.lstCheckBoxes[0].setChecked(True)
window.energiseScreen.sendCommand()
result["energised"] = ask("m7501")

# Gather window.
ask("#1j/")
ask("#1j=0")
wait(lambda: abs(position()) < 3)
form = window.pmacgatherScreen
form.lneNumberSamples.setText("500")
form.lneSampleTime.setText("2")
form.chkPlot1.setChecked(True)
form.chkPlot2.setChecked(True)
form.cmbDataSource1.setCurrentIndex(0)
form.cmbDataSource2.setCurrentIndex(1)
form.servoCyclesChanged()
form.applyConfigClicked()
form.setupClicked()
form.triggerClicked()
ask("#1j=2000")
pump(1.0)
form.collectClicked()
result["channels"] = [np.asarray(c.scaledData, dtype=float).tolist() for c in form.lstChannels]

# Download of a configuration file, with one bad line.
path = Path(folder) / "load.pmc"
path.write_text(
    "#define COUNTER P501\nCLOSE\nOPEN PLC 9\nCLEAR\nCOUNTER=COUNTER+1\nCLOSE\n"
    "P500=7\nNO SUCH WORD\nI5=2\nENABLE PLC 9\n"
)
QFileDialog.getOpenFileName = lambda *_arguments, **_options: (str(path), "")
window.pmacLoadConfig()
pump(1.5)
result["shell"] = window.txtShell.toPlainText()[-600:]
result["loaded"] = [ask("p500"), ask("list plc 9"), float(ask("p501")) > 0]
window.pmacPollingStatus()
pump(0.2)
window.pmacPollingStatus()
window.lneSend.setText("ver")
window.sendSingleCommand()
result["typed"] = window.txtShell.toPlainText()[-60:]
result["identity"] = window.lblIdentity.text()
result["problems"] = list(problems)
print(json.dumps(result))
sys.stdout.flush()
window.commsThread.inputQueue.put(("die", ""))
os._exit(0)
