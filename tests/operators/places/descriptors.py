"""Descriptors that look like those of features: they vary along fewer directions than they have numbers."""

import numpy as np
import numpy.typing as npt

Bits = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.float32]
_LATENT = 48


def binary(count: int, seed: int, num_bytes: int = 64) -> Bits:
    """Signs of random mixtures, as the intensity tests of BRISK are correlated."""
    mixtures = np.random.default_rng(99).standard_normal((_LATENT, 8 * num_bytes))
    latent = np.random.default_rng(seed).standard_normal((count, _LATENT))
    return np.packbits(latent @ mixtures > 0, axis=1)


def with_flipped_bits(bits: Bits, fraction: float, seed: int) -> Bits:
    """The same points seen again."""
    flipped = np.random.default_rng(seed).random((len(bits), 8 * bits.shape[1])) < fraction
    return bits ^ np.packbits(flipped, axis=1)


def numbers(count: int, seed: int, width: int = 32) -> Numbers:
    """Unit vectors around a subspace."""
    mixtures = np.random.default_rng(98).standard_normal((width // 2, width))
    rng = np.random.default_rng(seed)
    mixed = rng.standard_normal((count, width // 2)) @ mixtures
    return unit(mixed + 0.5 * rng.standard_normal((count, width)))


def with_noise(found: Numbers, sigma: float, seed: int) -> Numbers:
    """The same points seen again."""
    return unit(found + sigma * np.random.default_rng(seed).standard_normal(found.shape))


def unit(vectors: npt.NDArray[np.float64]) -> Numbers:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    scaled: Numbers = (vectors / lengths).astype(np.float32)
    return scaled
