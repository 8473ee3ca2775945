"""Write recordings while the arm moves, and read them back one block at a time, whatever file they lie in."""
