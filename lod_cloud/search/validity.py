"""Treelets with validity balls: re-tested only when the camera has left theirs."""

from __future__ import annotations

from typing import ClassVar

from lod_cloud.search.temporal import TemporalSearch


class ValiditySearch(TemporalSearch):
    """As `TemporalSearch`, without the treelets in which nothing can have changed.

    A decision taken at distance D with threshold T holds while the camera stays within |D - T| of
    where it was taken (less a slack for float32, see `lod_cloud.search.wheel_buckets`); a treelet
    holds for the least of its nodes. A search looks at the ball of every bearing treelet.
    """

    name: ClassVar[str] = "validity"
    _keeps_valid: ClassVar[bool] = True
