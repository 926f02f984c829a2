"""dls-pmaccontrol, unmodified, without a screen: main window polls, gather form collects."""

import json
import sys
import time
from types import SimpleNamespace

import numpy as np
from PyQt5.QtWidgets import QApplication, QMessageBox

host, port = sys.argv[1:3]
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


def pump(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        app.processEvents()
        time.sleep(0.01)


window.remoteConnect()
pump(2.0)
result = {"identity": window.lblIdentity.text(), "polled": window.table.item(0, 0).text()}
window.pmac.sendCommand("#1j/")
window.pmac.sendCommand("#1j=2000")
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
pump(1.5)
form.collectClicked()
result["channels"] = [np.asarray(ch.scaledData, dtype=float).tolist() for ch in form.lstChannels]
pump(1.0)
result["position"] = window.table.item(0, 0).text()
result["problems"] = problems
window.commsThread.inputQueue.put(("die", ""))
print(json.dumps(result))
sys.stdout.flush()
import os  # noqa: E402

os._exit(0)
