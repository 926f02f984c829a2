"""How long work tells what it does: three forms of the function that it calls meanwhile."""

from collections.abc import Callable

Progress = Callable[[str, float], None]  # what is being done, and what share of it is done
Tell = Callable[[str], None]  # what is being done
Steps = Callable[[str, int, int], None]  # what is being done, how many are done, of how many
