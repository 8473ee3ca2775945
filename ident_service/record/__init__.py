"""Recordings: written while the arm moves, read back one block at a time, whatever file they lie in."""
