"""Export an identified arm to other formats; each file is read back and checked."""
