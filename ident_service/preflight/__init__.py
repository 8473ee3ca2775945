"""Check an arm that stands on its support before it may move; the findings are a ticket."""
