"""Service: the jobs that the command line and, later, the daemon run."""
