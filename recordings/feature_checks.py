"""What keeps the features of another program from being used, or makes them mean something else."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mapstream.streams.messages.vision import NO_TRACK, ImageFeatures

_MAX_OFFSET_NS = 1_000_000_000  # of a keypoint after the stamp of its image
_NORMALISED = 4.0  # no pixel of a whole image is so near to the corner
_ENOUGH = 10  # keypoints to judge all by


def feature_faults(message: ImageFeatures) -> list[str]:
    """Return what is wrong with the features of an image; nothing if they can be used."""
    found = []
    if message.descriptors.size and message.descriptors.dtype not in (np.uint8, np.float32):
        found.append(f"descriptors are uint8 bits or float32, not {message.descriptors.dtype}")
    elif not np.isfinite(message.descriptors).all():
        found.append("descriptors are not finite")
    if not message.kind:
        found.append("no `kind`; features of different kinds never meet, so it needs a name")
    if not message.frame:
        found.append("no `frame`; it names the camera, as the sensor file does")
    return found + _place_faults(message) + _track_faults(message) + _certainty_faults(message)


def width_fault(message: ImageFeatures, before: ImageFeatures) -> str:
    """Return how descriptors differ from those of the same kind before; the empty text if they do not."""
    shape = _shape_of(message)
    if shape == _shape_of(before) or not len(message) or not len(before):
        return ""
    return f"descriptors of kind {message.kind} are {shape}, and were {_shape_of(before)} before"


def _shape_of(message: ImageFeatures) -> str:
    return f"{message.descriptors.dtype} x {message.descriptors.shape[1]}"


def _place_faults(message: ImageFeatures) -> list[str]:
    px, camera = message.keypoints_px, message.camera
    if not np.isfinite(px).all():
        return ["keypoints are not finite"]
    if len(px) < _ENOUGH or message.points_m is not None:  # points alone say where they are
        return []
    if np.abs(px).max() < _NORMALISED:
        return ["keypoints are pixels, these look normalised: all are within 4 px of the corner"]
    if camera is not None:
        size_px = np.array([camera.width_px, camera.height_px])
        outside = ((px < -0.5) | (px > size_px - 0.5)).any(axis=1)
        if outside.mean() > 0.5:
            size = f"{camera.width_px} x {camera.height_px} px"
            return [f"most keypoints are outside of the image, which is calibrated for {size}"]
    return []


def _track_faults(message: ImageFeatures) -> list[str]:
    if message.track_ids is None:
        return []
    ids = message.track_ids[message.track_ids != NO_TRACK]
    found = []
    if (ids < 0).any():
        found.append(f"track ids are not negative, but for {NO_TRACK}: no track")
    if len(np.unique(ids)) != len(ids):
        found.append("a track id comes twice in one image; it names one point")
    return found


def _certainty_faults(message: ImageFeatures) -> list[str]:
    found = []
    known: npt.NDArray[np.bool_] = np.ones(len(message), np.bool_)
    if message.points_m is not None:
        finite = np.isfinite(message.points_m)
        known = np.asarray(finite.all(axis=1))
        is_torn = finite.any(axis=1) & ~known
        if is_torn.any() or np.isinf(message.points_m).any():
            found.append("points_m are whole, or NaN as a whole where only a ray is known")
    for name, of in (("sigmas_px", np.ones_like(known)), ("point_sigmas_m", known)):
        sigmas = getattr(message, name)
        if sigmas is not None and not _are_sigmas(sigmas[of]):
            found.append(f"{name} are finite and positive; zeros would mean exact knowledge")
    offsets_ns = message.offsets_ns
    if offsets_ns is not None and len(offsets_ns) and np.abs(offsets_ns).max() > _MAX_OFFSET_NS:
        found.append("offsets_ns count from stamp_ns, and are less than a second")
    return found


def _are_sigmas(values: npt.NDArray[np.floating]) -> bool:
    return bool((np.isfinite(values) & (values > 0)).all())
