"""Experts behind HTTP servers."""
