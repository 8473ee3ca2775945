"""Compare two or more parameter sets, and present the changes as a document, text and a page."""
