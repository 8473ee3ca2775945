"""Simulate arms: a plant with true parameters, behind the same contract as a real arm."""
