"""The agent for others: an HTTP server for robots and services (`api`) and a web page for people (`page`)."""

from pathlib import Path

EXAMPLES_FOLDER = Path(__file__).resolve().parent / "examples"
"""Pictures for the page's examples, and for warming up."""
