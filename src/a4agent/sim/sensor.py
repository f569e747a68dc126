"""What a camera adds to a rendered picture: lens blur, exposure, colour cast, shading to the corners, noise."""

from __future__ import annotations

import numpy as np

BRIGHTEST = 0.85
"""What the automatic exposure lets most of the picture reach, of 1."""


def expose(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A rendered picture (H, W, 3) uint8 as a sensor would see it, same shape and type."""
    from scipy.ndimage import gaussian_filter

    light = (image.astype(np.float32) / 255) ** 2.2
    if rng.random() < 0.5:
        light = gaussian_filter(light, sigma=(*[rng.uniform(0.3, 1.0)] * 2, 0))
    gain = min(rng.uniform(0.9, 1.4), BRIGHTEST / max(float(np.quantile(light, 0.97)), 1e-3))
    light = light * rng.normal(1.0, 0.04, 3) * gain * _vignette(image.shape[:2], rng.uniform(0.0, 0.3))
    photons = 10 ** rng.uniform(2.3, 4.0)
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    light = light + noise * np.sqrt(np.clip(light, 0, 1) / photons + (0.2 / photons) ** 2 + 1e-6)
    return np.clip(255 * np.clip(light, 0, 1) ** (1 / 2.2) + 0.5, 0, 255).astype(np.uint8)


def _vignette(shape: tuple[int, int], strength: float) -> np.ndarray:
    rows, columns = (np.linspace(-1, 1, side, dtype=np.float32) for side in shape)
    return (1 - strength * (rows[:, None] ** 2 + columns[None] ** 2) / 2)[..., None]
