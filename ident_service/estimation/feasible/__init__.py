"""The feasible set and the optimisation problems over it: test, correction, constrained regression, priors."""
