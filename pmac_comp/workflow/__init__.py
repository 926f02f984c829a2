"""The bridge between the towers: calibrate, deploy, verify, improve. The only place of both."""
