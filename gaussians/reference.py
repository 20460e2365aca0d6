"""The slow, obvious renderer: conventions.md line by line, in plain NumPy.

It shares no kernel with the fast path (only the spherical-harmonic constants and the camera),
knows no tiles, no lists and no help between the eyes: every pixel meets every splat. Its images
are the definition of "right": the fast renderer must give the same bits.

NumPy float32 operations are rounded one by one (IEEE 754, nothing fused), and a Python number
beside a float32 array is taken as float32, so an expression below means exactly what
conventions.md writes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.constants import SH_C0, SH_C1, SH_C2, SH_C3
from gaussians.errors import InputError
from gaussians.scene import Scene

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Eye = Literal["left", "right"]


@dataclass(frozen=True)
class ReferenceCulls:
    """Gaussians that no eye draws, by the first reason that applies."""

    behind_near: int  # depth below the near plane, or not finite
    transparent: int  # opacity below 1/255
    degenerate: int  # determinant not positive or not finite, in either eye


@dataclass(frozen=True)
class ReferenceSplats:
    """The projected splats of one eye in drawing order, nearest first; [M] float32 unless said."""

    ids: NDArray[np.int32]  # number of the Gaussian in the scene
    depths: Float32  # z, metres, the same for both eyes
    u: Float32  # centre, columns of this eye's window
    v: Float32  # centre, rows
    a: Float32  # conic: exponent p = -0.5*(a*dx*dx + c*dy*dy) - b*dx*dy
    b: Float32
    c: Float32
    thresholds: Float32  # smallest exponent that passes
    opacities: Float32
    rgb: Float32  # [M, 3] colour towards this eye, >= 0


@dataclass(frozen=True)
class ReferenceImage:
    """What one eye sees."""

    image: Float32  # [height, width, 3]
    transmittance: Float32  # [height, width] share of the background that shows through
    ids: NDArray[np.int32]  # [M] the Gaussians that passed the culls, in drawing order
    culls: ReferenceCulls


def render_eye(
    scene: Scene, rig: StereoRig, eye: Eye, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> ReferenceImage:
    """The image of one eye, every splat tried at every pixel. Cost: splats times pixels.

    Raises InputError for a bad scene, an eye other than "left" and "right", or a background that is
    not three finite numbers.
    """
    base = np.asarray(background, np.float32)
    if base.shape != (3,) or not np.isfinite(base).all():
        raise InputError(f"background must be three finite numbers, not {background}")
    splats, culls = project(scene, rig, eye)
    shape = (rig.display.height, rig.display.width)
    image = np.zeros((*shape, 3), np.float32)
    transmittance = np.ones(shape, np.float32)
    live = np.ones(shape, bool)
    with np.errstate(all="ignore"):
        for rank in range(len(splats.ids)):
            passing, alpha = check(splats, rank, shape)
            after = transmittance * (1 - alpha)
            stopping = live & passing & (after < 1e-4)
            blending = live & passing & ~stopping
            weight = alpha * transmittance
            blended = image + splats.rgb[rank] * weight[..., None]
            image = np.where(blending[..., None], blended, image)
            transmittance = np.where(blending, after, transmittance)
            live = live & ~stopping
        image = image + transmittance[..., None] * base
    return ReferenceImage(image, transmittance, splats.ids, culls)


def check(splats: ReferenceSplats, rank: int, shape: tuple[int, int]) -> tuple[Bool, Float32]:
    """Where splat ``rank`` passes, and its alpha (meaningful there only), both [height, width]."""
    height, width = shape
    dx = (np.arange(width, dtype=np.float32) + 0.5)[None, :] - splats.u[rank]
    dy = (np.arange(height, dtype=np.float32) + 0.5)[:, None] - splats.v[rank]
    a, b, c = splats.a[rank], splats.b[rank], splats.c[rank]
    p = np.float32(-0.5) * ((a * dx) * dx + (c * dy) * dy) - (b * dx) * dy
    passing = (p <= 0) & (p >= splats.thresholds[rank])
    alpha = np.minimum(np.float32(0.99), splats.opacities[rank] * exp(np.where(passing, p, 0)))
    return passing, alpha


def exp(p: Float32) -> Float32:
    """exp(p), float32, for -87 < p <= 0: reduction by powers of two and a polynomial."""
    magic = np.float32(1.5 * 2**23)
    k = (p * np.float32(math.log2(math.e)) + magic) - magic
    r = (p - k * np.float32(0.693359375)) - k * np.float32(-2.12194440e-4)
    q = np.float32(0.0013933734) * r + np.float32(0.008363236)
    q = q * r + np.float32(0.041666463)
    q = q * r + np.float32(0.16666576)
    q = q * r + np.float32(0.5)
    return np.ldexp((q * (r * r) + r) + np.float32(1), k.astype(np.int32))


def project(scene: Scene, rig: StereoRig, eye: Eye) -> tuple[ReferenceSplats, ReferenceCulls]:
    """The splats one eye draws, in drawing order, and what was culled (for both eyes alike)."""
    if eye not in ("left", "right"):
        raise InputError(f'eye must be "left" or "right", not {eye!r}')
    scene.validate()
    with np.errstate(all="ignore"):
        x_left, y, z = _camera_coordinates(scene.means, rig)
        x_right = x_left - np.float32(rig.baseline_m)
        axes = _camera_axes(scene, rig)
        covariances = {
            "left": _covariance(axes, x_left, y, z, rig),
            "right": _covariance(axes, x_right, y, z, rig),
        }
        in_front = (z >= np.float32(rig.near_m)) & np.isfinite(z)
        opaque = scene.opacities >= np.float32(1 / 255)
        regular = np.ones(len(scene), bool)
        for covariance in covariances.values():
            det = _determinant(*covariance)
            regular &= (det > 0) & np.isfinite(det)
        u, v = _centre(x_left if eye == "left" else x_right, y, z, rig, eye)
        a, b, c = _conic(*covariances[eye])
        position = rig.left_position if eye == "left" else rig.right_position
        rgb = _colours(scene.sh, scene.means, position.astype(np.float32))
    culls = ReferenceCulls(
        behind_near=int((~in_front).sum()),
        transparent=int((in_front & ~opaque).sum()),
        degenerate=int((in_front & opaque & ~regular).sum()),
    )
    ids = np.flatnonzero(in_front & opaque & regular)
    # z > 0, so the order of the bit patterns is the order of the values; equal bits go by id
    ids = ids[np.lexsort((ids, z[ids].view(np.uint32)))]
    splats = ReferenceSplats(
        ids=ids.astype(np.int32),
        depths=z[ids],
        u=u[ids],
        v=v[ids],
        a=a[ids],
        b=b[ids],
        c=c[ids],
        thresholds=np.array([_threshold(o) for o in scene.opacities[ids]], np.float32),
        opacities=scene.opacities[ids],
        rgb=rgb[ids],
    )
    return splats, culls


def _camera_coordinates(means: Float32, rig: StereoRig) -> tuple[Float32, Float32, Float32]:
    """x, y, z of the means in the left camera, each [N]."""
    X, Y, Z = means.T
    x, y, z = (((r0 * X + r1 * Y) + r2 * Z) + t for r0, r1, r2, t in rig.world_to_left)
    return x, y, z


def _camera_axes(scene: Scene, rig: StereoRig) -> list[list[Float32]]:
    """t[i][j], each [N]: local axis j, as long as its standard deviation, in camera axes."""
    w, x, y, z = scene.quaternions.T
    r = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    m = [[r[i][j] * scene.scales[:, j] for j in range(3)] for i in range(3)]
    R = rig.world_to_left
    return [
        [(R[i, 0] * m[0][j] + R[i, 1] * m[1][j]) + R[i, 2] * m[2][j] for j in range(3)]
        for i in range(3)
    ]


def _covariance(
    t: list[list[Float32]], x: Float32, y: Float32, z: Float32, rig: StereoRig
) -> tuple[Float32, Float32, Float32]:
    """cxx, cxy, cyy in square pixels, each [N], of the eye whose camera coordinate is ``x``."""
    limit_x, limit_y = (np.float32(limit) for limit in rig.jacobian_limits)
    clamped_x = np.minimum(np.maximum(x / z, -limit_x), limit_x)
    clamped_y = np.minimum(np.maximum(y / z, -limit_y), limit_y)
    a0, a1, a2 = (t[0][j] - clamped_x * t[2][j] for j in range(3))
    b0, b1, b2 = (t[1][j] - clamped_y * t[2][j] for j in range(3))
    kx = np.float32(rig.display.fx) / z
    ky = np.float32(rig.display.fy) / z
    cxx = (kx * kx) * ((a0 * a0 + a1 * a1) + a2 * a2) + np.float32(0.3)
    cxy = (kx * ky) * ((a0 * b0 + a1 * b1) + a2 * b2)
    cyy = (ky * ky) * ((b0 * b0 + b1 * b1) + b2 * b2) + np.float32(0.3)
    return cxx, cxy, cyy


def _determinant(cxx: Float32, cxy: Float32, cyy: Float32) -> NDArray[np.float64]:
    """In float64 from the float32 covariance; [N]."""
    xx, xy, yy = (value.astype(np.float64) for value in (cxx, cxy, cyy))
    return xx * yy - xy * xy


def _conic(cxx: Float32, cxy: Float32, cyy: Float32) -> tuple[Float32, Float32, Float32]:
    """A, B, C: quotients in float64, each rounded once; [N]."""
    det = _determinant(cxx, cxy, cyy)
    a = (cyy.astype(np.float64) / det).astype(np.float32)
    b = (-cxy.astype(np.float64) / det).astype(np.float32)
    c = (cxx.astype(np.float64) / det).astype(np.float32)
    return a, b, c


def _centre(
    x: Float32, y: Float32, z: Float32, rig: StereoRig, eye: Eye
) -> tuple[Float32, Float32]:
    """Projected centre in the window of this eye; [N]."""
    display = rig.display
    cx = display.cx_left if eye == "left" else display.cx_right
    u = np.float32(display.fx) * (x / z) + np.float32(cx)
    v = np.float32(display.fy) * (y / z) + np.float32(display.cy)
    return u, v


def _threshold(opacity: np.float32) -> np.float32:
    """-ln(255 o) in float64, rounded up to float32."""
    exact = -math.log(255.0 * float(opacity))
    rounded = np.float32(exact)
    return rounded if float(rounded) >= exact else np.nextafter(rounded, np.float32(np.inf))


def _colours(sh: Float32, means: Float32, eye: Float32) -> Float32:
    """[N, 3]: the spherical harmonics in the direction from the eye to each mean."""
    d = means - eye
    dx, dy, dz = d.T
    n = np.sqrt((dx * dx + dy * dy) + dz * dz)
    # a mean in the eye itself has no direction: 0 / 1 stays 0
    x, y, z = (component[:, None] for component in (d / np.where(n == 0, 1, n)[:, None]).T)
    k = np.moveaxis(sh, 1, 0)  # k[i] is [N, 3]
    c = SH_C0 * k[0] + np.float32(0.5)
    if len(k) > 1:
        c = ((c - (SH_C1 * y) * k[1]) + (SH_C1 * z) * k[2]) - (SH_C1 * x) * k[3]
    if len(k) > 4:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        c = c + (SH_C2[0] * xy) * k[4]
        c = c + (SH_C2[1] * yz) * k[5]
        c = c + (SH_C2[2] * ((2 * zz - xx) - yy)) * k[6]
        c = c + (SH_C2[3] * xz) * k[7]
        c = c + (SH_C2[4] * (xx - yy)) * k[8]
    if len(k) > 9:
        c = c + ((SH_C3[0] * y) * (3 * xx - yy)) * k[9]
        c = c + ((SH_C3[1] * xy) * z) * k[10]
        c = c + ((SH_C3[2] * y) * ((4 * zz - xx) - yy)) * k[11]
        c = c + ((SH_C3[3] * z) * ((2 * zz - 3 * xx) - 3 * yy)) * k[12]
        c = c + ((SH_C3[4] * x) * ((4 * zz - xx) - yy)) * k[13]
        c = c + ((SH_C3[5] * z) * (xx - yy)) * k[14]
        c = c + ((SH_C3[6] * x) * (xx - 3 * yy)) * k[15]
    return np.maximum(c, 0)
