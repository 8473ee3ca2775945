"""Run jobs, each as a process of the command line; ids are converted to paths here only."""
