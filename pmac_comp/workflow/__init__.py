"""The bridge: calibrate, deploy, verify, improve; the only place where the towers meet."""
