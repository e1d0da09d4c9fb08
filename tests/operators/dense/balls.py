"""A ball, and a box around it, as depth cameras and LiDARs would see them: truth for dense maps."""

from __future__ import annotations

import numpy as np

from mapstream.operators.dense.cloud_integration import CloudView
from mapstream.operators.dense.depth_views import ColorView, DepthView, Pinhole
from mapstream.streams.arrays import Float32Array, FloatArray

CENTER = np.array([0.013, -0.021, 0.04])  # [m], on no voxel's border
RADIUS_M = 0.5
WIDTH, HEIGHT, FOCAL_PX = 120, 90, 110.0


def looking_at(eye: FloatArray, target: FloatArray) -> FloatArray:
    """Return T_map_camera (4, 4) of a camera that looks at a point."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.6, 0.8] if abs(z[2]) < 0.9 else [1.0, 0, 0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), eye
    return T


def rays() -> FloatArray:
    """Return the rays of depth 1 (H, W, 3) of all pixels, in the camera's frame."""
    u = (np.arange(WIDTH) - (WIDTH - 1) / 2) / FOCAL_PX
    v = (np.arange(HEIGHT) - (HEIGHT - 1) / 2) / FOCAL_PX
    return np.stack([*np.meshgrid(u, v), np.ones((HEIGHT, WIDTH))], axis=2)


def ball_ranges(eye: FloatArray, directions: FloatArray) -> FloatArray:
    """Return how many directions (..., 3) it is to the ball; NaN where they miss it."""
    to_eye = eye - CENTER
    a = (directions**2).sum(axis=-1)
    b = directions @ to_eye
    root = b * b - a * (to_eye @ to_eye - RADIUS_M**2)
    with np.errstate(invalid="ignore"):
        return np.where(root >= 0, (-b - np.sqrt(root)) / a, np.nan)


def ball_view(eye: FloatArray, *, rgb: tuple[int, int, int] | None = None) -> DepthView:
    """Return what a depth camera sees of the ball, of one colour if one is given."""
    T = looking_at(eye, CENTER)
    K = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1]])
    pinhole = Pinhole(camera_matrix=K, T_map_camera=T)
    depth_m: Float32Array = ball_ranges(eye, rays() @ T[:3, :3].T).astype(np.float32)
    color = None
    if rgb is not None:
        image = np.full((HEIGHT, WIDTH, 3), rgb, np.uint8)
        color = ColorView(rgb=image, pinhole=pinhole)
    return DepthView(depth_m=depth_m, pinhole=pinhole, color=color)


def eyes(distance_m: float = 1.4) -> FloatArray:
    """Return places (14, 3) all around the ball: faces and corners of a cube."""
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
    places: FloatArray = CENTER + distance_m * np.concatenate([faces, corners])
    return places


def ball_cloud(eye: FloatArray, num_points: int, seed: int) -> CloudView:
    """Return points on the side of the ball that one sees from a place."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(num_points, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = CENTER + RADIUS_M * normals
    is_seen = ((eye - points) * normals).sum(axis=1) > 0.1
    return CloudView(points=points[is_seen], origin=eye)
