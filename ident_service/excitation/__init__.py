"""Design excitation motions, and prove what they demand of the arm."""
