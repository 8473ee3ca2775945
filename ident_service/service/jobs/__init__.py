"""Jobs: each a process of its own that runs a verb of the command, with ids turned into paths here and nowhere else."""
