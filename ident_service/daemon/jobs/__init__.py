"""Run jobs: each in its own process that runs a verb of the command line, with ids turned into paths here only."""
