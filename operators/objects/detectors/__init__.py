"""Networks that find objects in images, each kind of file behind one call."""
