"""Model the arm: parameters and their names, mechanism, regressor, base parameters, information."""
