"""What an arm is, in configuration, and where each mistake in it stands."""
