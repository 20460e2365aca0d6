"""Which splats, and getting them across: LoD tree, search, Δcut, codec, link, both endpoints."""

from lod_cloud.build import BuildOptions, BuildTimes, build_tree, build_tree_files
from lod_cloud.client import Client, ReceiveStats, Selection
from lod_cloud.cloud import Cloud
from lod_cloud.codec import Codec, CompactCodec, PaperCodec
from lod_cloud.criterion import SearchRequest, prove_nesting
from lod_cloud.cut import Cut, is_complete, overlap
from lod_cloud.delta_cut import DeltaCut, Probe, Report
from lod_cloud.leaf_spool import LeafSpool
from lod_cloud.link import Link
from lod_cloud.lod_tree import LodTree, TreeMetadata
from lod_cloud.management_table import ManagementTable
from lod_cloud.protocol import LocalProtocolError, RemoteProtocolError
from lod_cloud.search import Search, SearchResult, SearchTree, flat_search, make_search
from lod_cloud.search_stats import SearchStats
from lod_cloud.tree_encoder import TreeEncoder
from lod_cloud.tree_files import load_tree, save_tree, verify_tree

__all__ = [
    "BuildOptions",
    "BuildTimes",
    "Client",
    "Cloud",
    "Codec",
    "CompactCodec",
    "Cut",
    "DeltaCut",
    "LeafSpool",
    "Link",
    "LocalProtocolError",
    "LodTree",
    "ManagementTable",
    "PaperCodec",
    "Probe",
    "ReceiveStats",
    "RemoteProtocolError",
    "Report",
    "Search",
    "SearchRequest",
    "SearchResult",
    "SearchStats",
    "SearchTree",
    "Selection",
    "TreeEncoder",
    "TreeMetadata",
    "build_tree",
    "build_tree_files",
    "flat_search",
    "is_complete",
    "load_tree",
    "make_search",
    "overlap",
    "prove_nesting",
    "save_tree",
    "verify_tree",
]
