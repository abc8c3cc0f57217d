"""What faults do to the loop: which reaction each has, and how far the estimated pose is off before and after it is told."""
