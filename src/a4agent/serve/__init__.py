"""The agent for others: an HTTP server for robots and services (`api`) and a web page for people (`app`)."""
