"""LoD searches behind one interface; all of them find the same cut, and say what changed."""

from __future__ import annotations

from gaussians.errors import InputError
from lod_cloud.search.auto import AutoSearch
from lod_cloud.search.city_gaussian import CityGaussianSearch
from lod_cloud.search.depth_first import DepthFirstSearch
from lod_cloud.search.flat import FlatSearch, flat_search
from lod_cloud.search.interface import Search, SearchResult
from lod_cloud.search.octree_gs import OctreeGsSearch
from lod_cloud.search.rule import RuleSearch, Selection
from lod_cloud.search.search_tree import SearchTree
from lod_cloud.search.streaming import StreamingSearch
from lod_cloud.search.temporal import TemporalSearch
from lod_cloud.search.validity import ValiditySearch
from lod_cloud.search.wheel import WheelSearch

SEARCHES: dict[str, type[Search]] = {
    search.name: search
    for search in (
        FlatSearch,
        DepthFirstSearch,
        StreamingSearch,
        TemporalSearch,
        ValiditySearch,
        WheelSearch,
        AutoSearch,
    )
}

__all__ = [
    "SEARCHES",
    "AutoSearch",
    "CityGaussianSearch",
    "DepthFirstSearch",
    "FlatSearch",
    "OctreeGsSearch",
    "RuleSearch",
    "Search",
    "SearchResult",
    "SearchTree",
    "Selection",
    "StreamingSearch",
    "TemporalSearch",
    "ValiditySearch",
    "WheelSearch",
    "flat_search",
    "make_search",
]


def make_search(method: str, tree: SearchTree, *, hysteresis: float = 0.0) -> Search:
    """A client's search by the name of its method. Raises InputError for an unknown one."""
    if method not in SEARCHES:
        raise InputError(f"search method must be one of {', '.join(SEARCHES)}, not {method!r}")
    return SEARCHES[method](tree, hysteresis=hysteresis)
