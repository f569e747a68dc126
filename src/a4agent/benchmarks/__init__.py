"""Readers of the benchmarks: one file each, opened by name through `registry.load`."""
