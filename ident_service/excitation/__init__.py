"""Design excitation motions, and prove that they keep the arm's limits."""
