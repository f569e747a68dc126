"""Experts that run in this process, on torch."""
