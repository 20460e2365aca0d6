"""Scenes, formats, cameras, and the functional mathematics of stereo Gaussian splatting."""

from gaussians import kernel_cache

kernel_cache.configure()
