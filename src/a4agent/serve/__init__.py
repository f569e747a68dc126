"""The agent as a service: over HTTP (`api`), as tools for language agents (`mcp_server`) and as a web page (`page`)."""

from pathlib import Path

EXAMPLES_FOLDER = Path(__file__).resolve().parent / "examples"
"""Pictures for the page's examples, and for warming up."""
