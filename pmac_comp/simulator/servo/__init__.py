"""The servo task: sensors, conversion table, trajectories, compensation, control law, gather."""
