"""From raw samples to the pose, stage by stage."""
