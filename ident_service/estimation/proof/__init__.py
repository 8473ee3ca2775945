"""Proofs in exact arithmetic that parameters are feasible or not, their verifier, and export for other solvers."""
