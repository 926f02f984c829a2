"""How long work tells what it does: the functions that it calls meanwhile, in three forms."""

from collections.abc import Callable

Progress = Callable[[str, float], None]  # what is being done, and what share of it is done
Tell = Callable[[str], None]  # what is being done
Steps = Callable[[str, int, int], None]  # what is being done, how many are done, of how many


def untold(text: str, share: float) -> None:
    """Progress that nobody listens to."""
