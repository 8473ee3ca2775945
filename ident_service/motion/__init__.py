"""Motion: references, control, guard and states; the loop between the mathematics and the arm."""
