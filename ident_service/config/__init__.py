"""Read arm descriptions from YAML, and report each mistake with file, line and column."""
