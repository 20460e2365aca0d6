"""Baseline rules: they select other sets than our cut, by construction."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search.search_tree import SearchTree


@dataclass(frozen=True)
class Selection:
    """Nodes a rule selects, and what finding them took."""

    node_ids: Int32
    nodes_tested: int
    bytes_touched: int


class RuleSearch(ABC):
    """A rule that selects nodes of a tree for a request; not necessarily a cut."""

    name: ClassVar[str]
    tree: SearchTree

    @abstractmethod
    def select(self, request: SearchRequest) -> Selection:
        """The nodes selected."""
