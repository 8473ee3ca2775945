"""Two or more parameter sets side by side, and what has changed between them: as a document, words and a page."""
