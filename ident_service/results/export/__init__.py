"""Export an identified arm: one file per format, each read back before it is kept."""
