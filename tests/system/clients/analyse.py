"""dls-pmacanalyse, unmodified: reads a whole configuration back. Arguments: host, port, folder."""

import sys

from dls_pmacanalyse.dls_pmacanalyse import main

host, port, folder = sys.argv[1:4]
sys.argv = [
    "dls-pmacanalyse",
    "--pmac=bench",
    f"--tcpip={host}:{port}",
    f"--backup={folder}",
    f"--resultsdir={folder}/results",
]
main()
