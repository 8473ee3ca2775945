"""A simulated arm: a plant that knows the truth, behind the same contract as a real one."""
