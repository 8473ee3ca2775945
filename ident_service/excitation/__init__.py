"""Excitation: motions that teach, and what they ask of the arm."""
