"""The arm model: parameters and their names, mechanism, regressor, base parameters, information."""
