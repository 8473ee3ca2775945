"""Gather, store and read the evidence that a report draws beside `parameters.json`."""
