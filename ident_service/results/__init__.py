"""Results: the parameter file, exports and the run folder."""
