"""gsplat's PyTorch reference on the CPU, beside this renderer, on a scene small enough for both.

gsplat supplies projection and spherical harmonics. Its reference for compositing needs CUDA, so its
definition of alpha is composited densely in PyTorch, every splat at every pixel.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gaussians.cameras import Display, StereoRig, look_at
from gaussians.render import render_mono
from gaussians.scene import Scene, normalised_quaternions

SIZE, SPLATS = 128, 2000


def small_scene() -> tuple[Scene, StereoRig]:
    """Ellipsoids around the origin, seen from 4 m."""
    rng = np.random.default_rng(0)
    scene = Scene(
        (rng.uniform(-1, 1, (SPLATS, 3)) * (3.5, 2.5, 1.8)).astype(np.float32),
        normalised_quaternions(rng.normal(size=(SPLATS, 4))),
        np.exp(rng.uniform(-4.0, -1.5, (SPLATS, 3))).astype(np.float32),
        rng.uniform(0.05, 0.95, SPLATS).astype(np.float32),
        rng.normal(0, 0.2, (SPLATS, 16, 3)).astype(np.float32),
    )
    pose = look_at(np.array([0.3, -0.2, -4.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    return scene, StereoRig(Display.from_fov(SIZE, SIZE, 60.0), pose)


def compare(repeat: int) -> dict[str, float] | None:
    """CPU seconds of both and their ratio, and the largest difference; None without gsplat."""
    try:
        import torch
        from gsplat.cuda import _torch_impl as gsplat
    except ImportError:
        return None
    torch.set_num_threads(1)
    scene, rig = small_scene()
    theirs, image = _best(lambda: _gsplat_image(torch, gsplat, scene, rig), repeat)
    ours, (mine, _transmittance) = _best(lambda: render_mono(scene, rig), repeat)
    largest = float(np.abs(mine - image.numpy()).max())
    return {"gsplat_cpu_s": theirs, "cpu_s": ours, "ratio": theirs / ours, "max_abs": largest}


def _best(function: Callable[[], Any], repeat: int) -> tuple[float, Any]:
    """Least CPU seconds after a first call that does not count, and the result."""
    result = function()
    times = []
    for _ in range(repeat):
        started = time.process_time()
        result = function()
        times.append(time.process_time() - started)
    return min(times), result


def _gsplat_image(torch: Any, gsplat: Any, scene: Scene, rig: StereoRig) -> Any:
    """[SIZE, SIZE, 3] of the left eye, float32."""
    d = rig.display
    means, quats, scales, opacities, sh = (
        torch.from_numpy(getattr(scene, name))
        for name in ("means", "quaternions", "scales", "opacities", "sh")
    )
    intrinsics = torch.tensor([[d.fx, 0, d.cx_left], [0, d.fy, d.cy], [0, 0, 1]])
    view = torch.eye(4)
    view[:3] = torch.from_numpy(rig.world_to_left)
    covariances, _ = gsplat._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    _, centres, depths, conics, _ = gsplat._fully_fused_projection(
        means, covariances, view[None], intrinsics[None], d.width, d.height, eps2d=0.3
    )
    order = torch.argsort(depths[0])
    centres, conics, opacities = centres[0][order], conics[0][order], opacities[order]
    towards = means - torch.from_numpy(rig.left_position.astype(np.float32))
    rgb = (gsplat._spherical_harmonics(3, towards, sh) + 0.5).clamp_min(0)[order]
    rows = [_dense_row(torch, row, centres, conics, opacities, rgb) for row in range(SIZE)]
    return torch.stack(rows)


def _dense_row(torch: Any, row: int, centres: Any, conics: Any, opacities: Any, rgb: Any) -> Any:
    """One image row [SIZE, 3]: alphas of every splat at every pixel, blended front to back."""
    dx = (torch.arange(SIZE) + 0.5)[:, None] - centres[None, :, 0]
    dy = (row + 0.5) - centres[None, :, 1]
    a, b, c = conics.unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp_max(0.999)
    alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, torch.zeros(()))
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones(SIZE, 1), after[:, :-1]], dim=1)
    return torch.where(after > 1e-4, alpha * before, torch.zeros(())) @ rgb
