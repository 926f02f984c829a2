"""How a simulated controller says that it is one: an answer to SID that no ID module can give.

The manual has 16 hex digits with family code and checksum, or ``0`` without the module (Software
Reference Manual p. 331, 395). Nothing that a simulated card does is a measurement, so whoever
stores or reports its samples must be able to tell.
"""

from typing import Final

SIMULATED_ID: Final = "51D0000000000000"
