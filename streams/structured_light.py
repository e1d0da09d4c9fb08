"""How sure a depth camera of structured light is.

Nguyen, Izadi, Lovell: Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking,
3DIMPVT 2012: the axial deviation grows with the square of the depth.
"""

from __future__ import annotations

from mapstream.streams.arrays import FloatArray


def depth_sigma_m(depth_m: FloatArray) -> FloatArray:
    """Return the standard deviations [m] of depths of any shape."""
    sigma_m: FloatArray = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    return sigma_m
