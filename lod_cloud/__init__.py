"""Which splats, and getting them across: LoD tree, search, Δcut, codec, link, both endpoints."""

from lod_cloud.build import build_tree
from lod_cloud.client import Client, ReceiveStats, Selection
from lod_cloud.cloud import Cloud, SearchStats, TreeEncoder
from lod_cloud.codec import PaperCodec
from lod_cloud.criterion import SearchRequest, prove_nesting
from lod_cloud.cut import Cut, difference, is_complete, overlap
from lod_cloud.delta_cut import DeltaCut, ManagementTable
from lod_cloud.full_search import flat_search
from lod_cloud.link import Link
from lod_cloud.lod_tree import LodTree, TreeMetadata
from lod_cloud.protocol import RemoteProtocolError
from lod_cloud.tree_files import load_tree, save_tree

__all__ = [
    "Client",
    "Cloud",
    "Cut",
    "DeltaCut",
    "Link",
    "LodTree",
    "ManagementTable",
    "PaperCodec",
    "ReceiveStats",
    "RemoteProtocolError",
    "SearchRequest",
    "SearchStats",
    "Selection",
    "TreeEncoder",
    "TreeMetadata",
    "build_tree",
    "difference",
    "flat_search",
    "is_complete",
    "load_tree",
    "overlap",
    "prove_nesting",
    "save_tree",
]
