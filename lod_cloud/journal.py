"""What the cloud remembers of messages that the client has not acknowledged."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from lod_cloud.lod_tree import Int32


@dataclass(frozen=True)
class Entry:
    """One message underway."""

    sequence: int
    state_hash: int  # of the table after it
    named: Int32  # nodes whose place it set; not all that it only completed
    brought: Int32  # nodes it sent or completed: the client may hold them or not, and how
    from_nothing: bool  # only a start from nothing makes up for it
    size: int  # node ids it was about

    @classmethod
    def start(cls, sequence: int, state_hash: int) -> Entry:
        """A message with base 0. Does not count: it cannot be made smaller."""
        return cls(sequence, state_hash, _NOTHING, _NOTHING, True, 0)

    @classmethod
    def change(
        cls, sequence: int, state_hash: int, named: Int32, brought: Int32, limit: int
    ) -> Entry:
        """Any other message. Of one about more than ``limit`` ids nothing is kept."""
        size = len(named) + len(brought)
        if size > limit:
            return cls(sequence, state_hash, _NOTHING, _NOTHING, True, size)
        return cls(sequence, state_hash, named, brought, False, size)


class Journal:
    """Messages underway, oldest first, and what the client is known to have applied.

    Bounded by two limits, beyond which it is `full` and the cloud must not send another step: a
    number of messages and a number of node ids. At most twice the latter are kept.
    """

    def __init__(self, messages: int, nodes: int) -> None:
        self.applied = 0  # sequence number the client has acknowledged
        self.applied_hash = 0
        self.node_limit = nodes
        self._message_limit = messages
        self._entries: deque[Entry] = deque()

    @property
    def full(self) -> bool:
        """Whether the client must acknowledge something first."""
        many = len(self._entries) >= self._message_limit
        return many or sum(entry.size for entry in self._entries) > self.node_limit

    @property
    def node_count(self) -> int:
        """Node ids kept, 4 B each."""
        return sum(len(entry.named) + len(entry.brought) for entry in self._entries)

    @property
    def state_bytes(self) -> int:
        """Memory of the journal."""
        return 4 * self.node_count

    def add(self, entry: Entry) -> None:
        """A step: it follows the message before."""
        self._entries.append(entry)

    def replace(self, entry: Entry) -> None:
        """A message that makes all those underway superfluous, and names what they named."""
        self._entries.clear()
        self._entries.append(entry)

    def acknowledge(self, sequence: int, state_hash: int) -> bool:
        """The client applied ``sequence``; False when its state is not the one it should have.

        A message that another one has made superfluous since does not count as acknowledged: its
        hash is not known any more, and the other one leads on from it all the same.
        """
        if sequence == self.applied:
            return state_hash == self.applied_hash
        for entry in self._entries:
            if entry.sequence == sequence:
                if entry.state_hash != state_hash:
                    return False
                break
        else:
            return True
        while self._entries and self._entries[0].sequence <= sequence:
            self._entries.popleft()
        self.applied, self.applied_hash = sequence, state_hash
        return True

    def unacknowledged(self) -> tuple[Int32, Int32] | None:
        """Nodes named and brought by the messages underway, ascending; None when it takes a start
        from nothing to make up for them.
        """
        if self.applied == 0 or any(entry.from_nothing for entry in self._entries):
            return None
        brought = np.unique(np.concatenate([_NOTHING, *(e.brought for e in self._entries)]))
        named = np.unique(np.concatenate([brought, *(e.named for e in self._entries)]))
        return None if len(named) + len(brought) > self.node_limit else (named, brought)


_NOTHING = np.empty(0, np.int32)
