"""Estimate physically feasible parameters from recordings, with uncertainty, certificate and verdicts."""
