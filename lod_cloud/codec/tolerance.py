"""How far a Gaussian that a client merged itself may be from the tree's.

Let n be a node that a client merged, at any depth, from nodes i that were sent. A node is sent in
few bits only if its decoded mean is within c s_i per axis, s_i its largest standard deviation, and
its decoded mass (opacity x surface) within a factor 1 +- eps; else it is sent exactly. Masses, and
means and second moments weighted with them, are additive under merging. With p_i the shares of the
mass of n:

    m'_n - m_n = sum p'_i (m'_i - m_i) + sum (p'_i - p_i) (m_i - m_n)

|p'_i - p_i| <= eta p_i with eta = 2 eps / (1 - eps), sum p_i s_i <= sqrt(sum p_i trace C_i) <=
sqrt(trace C_n) <= sqrt(3) s_n, and sum p_i |m_i - m_n| <= s_n per axis. Hence

    |m'_n - m_n| <= kappa s_n,   kappa = (1 + eta) sqrt(3) (c + 2 L delta) + eta

in a tree of L levels, where every merge on the way may be off by delta s, and be rounded to
float32 by as much, and its mass by a factor 1 +- 1e-5 (eps is L times that larger in eta). A client
merges only where the tree's own merge meets that, which is measured (`lod_cloud.siblings`), else
the node is sent. That rules out children without mass, Gaussians that are no merges, and
coordinates too large for float32.
"""

from __future__ import annotations

import math

from lod_cloud.siblings import MASS_ERROR, MEAN_ERROR

CODED_MASS_ERROR = 0.09  # eps; the codes of scales and opacity are worth about 0.08 at most
_FLOAT32_MASS_ERROR = 1e-6


def merge_tolerance(mean_error: float, levels: int) -> float:
    """kappa: largest error of a mean per axis, in largest standard deviations, where c is
    ``mean_error``; for merged nodes of a tree of so many levels, and for those sent.
    """
    eps = CODED_MASS_ERROR + levels * (MASS_ERROR + _FLOAT32_MASS_ERROR)
    eta = 2 * eps / (1 - eps)
    return (1 + eta) * math.sqrt(3) * (mean_error + 2 * levels * MEAN_ERROR) + eta
