"""What happened in a frame, counted: the only thing energy is computed from (besides time)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

# name -> (unit, sentence). Every name has a price in the cost table, every price a name here.
COUNTERS: dict[str, tuple[str, str]] = {
    "radio_bytes_received": ("B", "bytes that came over the wireless link"),
    "attributes_dequantised": ("count", "coded attributes turned back into numbers by the decoder"),
    "codebook_words_read": ("16 B words", "codeword data read from the codebook buffer"),
    "headers_walked": ("count", "headers tested for level of detail and frustum"),
    "splats_transformed": ("count", "means moved into camera space, per projection pass"),
    "covariances_built": ("count", "covariances turned into camera axes"),
    "conics_computed": ("count", "image-space conics and centres, per eye"),
    "sh_coefficients": (
        "count",
        "spherical-harmonic coefficients weighted and summed, per channel",
    ),
    "row_spans_solved": ("count", "spans of tiles a splat covers in a tile row, per eye"),
    "pairs_emitted": ("count", "(splat, tile) pairs written to tile lists"),
    "sort_comparisons": ("count", "compare-exchanges of pivots and bitonic network"),
    "global_buffer_reads": ("16 B words", "words read from the global buffer"),
    "global_buffer_writes": ("16 B words", "words written to the global buffer"),
    "list_entries_walked": ("count", "list entries broadcast to rendering units or to the SRU"),
    "feature_buffer_reads": ("16 B words", "words read from the feature buffers"),
    "feature_buffer_writes": ("16 B words", "words written to the feature buffers"),
    "alpha_checks": ("count", "live pixels tested against a splat"),
    "alpha_passes": ("count", "tests passed: exponential and alpha"),
    "blends": ("count", "passes blended into a pixel"),
    "pixels_written": ("count", "pixels handed to the frame buffer, both eyes"),
    "sru_entries_examined": ("count", "list entries the stereo re-projection unit looked at"),
    "stereo_buffer_writes": ("entries", "splats written into a row of the stereo buffer"),
    "stereo_buffer_reads": ("entries", "splats popped from a row of the stereo buffer"),
    "merge_comparisons": ("count", "comparisons of row heads in the merge unit"),
    "dram_activations": ("count", "DRAM rows opened and closed"),
    "dram_bytes_read": ("B", "bytes read from DRAM, display scan-out included"),
    "dram_bytes_written": ("B", "bytes written to DRAM"),
}


@dataclass(frozen=True)
class Count:
    """One counter of a frame."""

    name: str
    unit: str
    sentence: str
    value: int


@dataclass(frozen=True)
class Activity:
    """All counters of a frame, in the order of ``COUNTERS``."""

    counts: tuple[Count, ...]

    def __getitem__(self, name: str) -> int:
        for count in self.counts:
            if count.name == name:
                return count.value
        raise KeyError(name)

    @classmethod
    def collect(cls, parts: Iterable[Mapping[str, int]]) -> Activity:
        """Sum the counts of several units; KeyError for a name not in ``COUNTERS``."""
        totals = dict.fromkeys(COUNTERS, 0)
        for part in parts:
            for name, value in part.items():
                totals[name] = totals[name] + int(value)
        return cls(tuple(Count(n, *COUNTERS[n], value) for n, value in totals.items()))

    def scaled(self, numerator: int, denominator: int) -> Activity:
        """Every count times numerator/denominator, rounded down (means over frames, what-ifs)."""
        return Activity(
            tuple(replace(c, value=c.value * numerator // denominator) for c in self.counts)
        )
