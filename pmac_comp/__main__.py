"""``python -m pmac_comp`` is the command ``pmac-comp``."""

from pmac_comp.cli.app import main

if __name__ == "__main__":
    main()
