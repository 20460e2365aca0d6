"""Constants of the splatting mathematics, once, in float32.

Kernels use these module-level ``np.float32`` values only: a Python float inside a kernel would
promote the operation to float64 under numba but not under NumPy. Their use is written down in
conventions.md.
"""

import numpy as np

ALPHA_MAX = np.float32(0.99)  # 3DGS: a splat never hides everything behind it
TRANSMITTANCE_STOP = np.float32(1e-4)  # 3DGS: a pixel stops before it would fall below this
DILATION_PX2 = np.float32(0.3)  # 3DGS: added to both diagonal entries of the image-space covariance
FRUSTUM_CLAMP = 1.3  # 3DGS: x/z and y/z inside the Jacobian are clamped to 1.3 tan(fov/2)
OPACITY_MIN = np.float32(1.0 / 255.0)  # a fainter splat cannot pass any pixel
OPACITY_LIMIT = 1e6  # merged LoD parents exceed 1 (44 seen); beyond this the file is damaged

# Real spherical harmonics, degree 0 to 3, signs as in the INRIA files.
SH_C0 = np.float32(0.28209479177387814)
SH_C1 = np.float32(0.4886025119029199)
SH_C2 = np.array(
    [
        1.0925484305920792,
        -1.0925484305920792,
        0.31539156525252005,
        -1.0925484305920792,
        0.5462742152960396,
    ],
    np.float32,
)
SH_C3 = np.array(
    [
        -0.5900435899266435,
        2.890611442640554,
        -0.4570457994644658,
        0.3731763325901154,
        -0.4570457994644658,
        1.445305721320277,
        -0.5900435899266435,
    ],
    np.float32,
)

# Columns of a feature record: the ten words a rendering unit needs of one splat
U, V, CONIC_A, CONIC_B, CONIC_C, THRESHOLD, OPACITY, RED, GREEN, BLUE = range(10)
FEATURES = 10
