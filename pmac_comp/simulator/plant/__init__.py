"""The mechanics behind the simulated card, written from the equations a second time."""
