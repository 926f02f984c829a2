"""The controller: counts and registers; knows no physics."""
