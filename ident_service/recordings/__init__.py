"""Record runs through a ring in shared memory to MCAP, and read MCAP and CSV recordings block by block."""
