"""Byte carriers: TCP, UDP, serial, SSH, in-process pair, fault-injecting tap."""
