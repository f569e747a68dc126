"""Adapters to other programs; each needs only its own library."""
