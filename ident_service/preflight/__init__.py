"""Check a supported arm before it may move; the result is a ticket."""
