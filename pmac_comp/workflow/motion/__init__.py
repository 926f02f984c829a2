"""Command files and motions, campaigns of them, and how the controller is given one."""
