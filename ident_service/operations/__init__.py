"""Carry out the jobs that the command line and the daemon share."""
