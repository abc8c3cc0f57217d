"""Integrity: whether the estimated pose can be believed, what is wrong if not, and by how much it may be off."""
