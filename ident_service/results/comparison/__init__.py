"""Compare parameter sets, and present the changes as JSON, text and an HTML page."""
