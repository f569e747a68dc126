"""Runs: a benchmark scored by one configuration, kept as a folder that survives a kill, reported and compared."""
