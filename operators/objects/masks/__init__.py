"""Which points and pixels in the box of a detection are of the object."""
