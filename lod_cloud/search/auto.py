"""The search to use: the wheel while little changes, the stream when much does."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search import wheel_decisions as decisions
from lod_cloud.search.marks import set_marks
from lod_cloud.search.search_tree import SearchTree
from lod_cloud.search.wheel import WheelSearch

_TESTS_SHARE = 1 / 128  # of the nodes the last full search tested: what the wheel may test instead
_FILL_SHARE = 1 / 256  # likewise, the entries that may be made beside a full search
_PARTS = 64  # at most one of so many of the tree is looked at for them: pages new to the process
_LEAST = 256


class AutoSearch(WheelSearch):
    """A wheel with a bounded worst case.

    A *jump* is noticed by its consequences: more entries due, or more nodes to test, than a
    fraction of what a full search would test (or another tau or focal length). What the wheel has
    done by then is taken back, and the search is streamed. The wheel is then filled a little with
    every search; until it is complete searches are streamed. So no search costs much more than a
    full one, the first included.
    """

    name: ClassVar[str] = "auto"

    def __init__(self, tree: SearchTree, *, hysteresis: float = 0.0) -> None:
        super().__init__(tree, hysteresis=hysteresis)
        self._filled = 0  # nodes looked at so far; all of them: the wheel is complete
        self._full_tests = 0  # of the last full search

    def _advance(self, request: SearchRequest) -> tuple[Int32, Int32, int, int]:
        if request.factor != self._factor:
            return self._jump(request)
        budget = max(_LEAST, int(self._full_tests * _TESTS_SHARE))
        due = self._collect(request)
        if len(due) > budget:
            return self._jump(request)
        if self._filled < len(self.tree):
            return self._fill_further(request, due)
        expanded, collapsed, tested = self._settle(due, budget)
        if tested > budget:
            set_marks(expanded, self.refined, False)
            set_marks(collapsed, self.refined, True)
            return self._jump(request, tested)
        return np.sort(expanded), np.sort(collapsed), tested, self._touched(len(due), tested)

    def _jump(self, request: SearchRequest, wasted: int = 0) -> tuple[Int32, Int32, int, int]:
        """A full search; the wheel starts empty, to be filled from the next search on."""
        self._clear()
        self._filled = 0
        self._camera, self._factor = request.camera, request.factor
        expanded, collapsed, tested, touched = self._stream(request)
        self._full_tests = tested
        return expanded, collapsed, tested + wasted, touched + self._touched(0, wasted)

    def _fill_further(self, request: SearchRequest, due: Int32) -> tuple[Int32, Int32, int, int]:
        """A full search; entries that are due or became active are made anew, and some more."""
        set_marks(due, self._scheduled, False)
        expanded, collapsed, tested, touched = self._stream(request)
        self._full_tests = tested
        changed = np.concatenate([due, expanded, collapsed])
        self._insert(decisions.active_among(changed, self._ints, self.refined, self._scheduled))
        end = min(len(self.tree), self._filled + max(_LEAST, len(self.tree) // _PARTS))
        self._filled = self._fill(self._filled, end, max(_LEAST, int(tested * _FILL_SHARE)))
        return expanded, collapsed, tested, touched + self._touched(len(changed), 0)
