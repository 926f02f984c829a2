"""The simulated Turbo PMAC: memory, interpreter, servo, tables, gather, plant, servers."""
