"""Objects followed from image to image."""
