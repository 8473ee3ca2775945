"""Define the feasible set and solve the problems over it: test, correction, constrained regression, priors."""
