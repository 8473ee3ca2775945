"""Estimate parameters that a real body could have from equations, with their uncertainty."""
