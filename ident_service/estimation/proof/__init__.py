"""Prove in exact arithmetic that parameters are feasible or not, and export the problems for other solvers."""
