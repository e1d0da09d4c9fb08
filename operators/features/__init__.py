"""Detectors and descriptors: keypoints of an image, and what is done with sets of them."""
