"""Trees of structures made elsewhere: placed copies, trained levels, voxels."""

from lod_cloud.imports.block_tree import build_block_tree
from lod_cloud.imports.instances import build_instanced_files
from lod_cloud.imports.octree import build_octree

__all__ = ["build_block_tree", "build_instanced_files", "build_octree"]
