"""Plants behind the simulated card: our ball-screw drive and the door for a user's own.

What lives here: true drives, written from the equations of motion a second time. What may not: the
model that is fitted, and anything of the card. Imports ``files`` and ``base``.
"""

from pmac_comp.simulator.plant.ballscrew import BallscrewPlant, make_plant
from pmac_comp.simulator.plant.door import GuardedPlant, Plant, load_plant

__all__ = ["BallscrewPlant", "GuardedPlant", "Plant", "load_plant", "make_plant"]
