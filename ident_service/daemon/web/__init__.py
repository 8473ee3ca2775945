"""Serve the web pages, rendered on the server; they work without scripts, except where a lease must be renewed."""
