"""Describe an arm in configuration files, and report each mistake in them with its place."""
