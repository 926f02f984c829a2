"""What a PMAC has: variables, motors, tables, gather, open servo, backup, upload."""
