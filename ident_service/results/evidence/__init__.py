"""Collect, store and read the data behind a report (`evidence.json`)."""
