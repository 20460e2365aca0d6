"""``python -m benchmarks.fuzz_formats``: many damaged files per reader; counts, time, memory.

Run from the root of the checkout. The process also holds the attacks themselves. Exits with status
1 at a file that neither loads nor is refused with an InputError, takes longer than two seconds, or
needs too much memory.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
import tracemalloc
import warnings
from dataclasses import replace
from pathlib import Path

from tests.fuzz_formats import Outcome, fuzz
from tests.fuzz_targets import READERS

SLOWEST_S = 2.0
ONE_LOAD_MIB, PROCESS_MIB = 24, 512
TRACED_PART = 20  # one file in so many is repeated with its memory traced, bombs among them


def measure(reader: str, mutations: int, seed: int) -> tuple[Outcome, float, float]:
    """Outcome, seconds, and peak resident memory in MiB; for a fresh process."""
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory(prefix="nebula-fuzz-") as folder:
        started = time.perf_counter()
        outcome = fuzz(reader, mutations, seed, Path(folder))
        total = time.perf_counter() - started
        tracemalloc.start()
        traced = fuzz(reader, mutations // TRACED_PART, seed + 1, Path(folder))
        return replace(outcome, peak_bytes=traced.peak_bytes), total, _peak_mib()


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("readers", nargs="*", default=READERS, metavar="READER", help=str(READERS))
    parser.add_argument("--mutations", type=int, default=20_000, help="per reader")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print("reader          files   loaded  refused   total s  slowest s  one load MiB  process MiB")
    failed = False
    context = multiprocessing.get_context("spawn")
    for reader in arguments.readers:
        with context.Pool(1) as pool:  # one process per reader, so that peaks are its own
            outcome, total, peak = pool.apply(
                measure, (reader, arguments.mutations, arguments.seed)
            )
        print(
            f"{reader:14}{outcome.loaded + outcome.refused:7}{outcome.loaded:9}{outcome.refused:9}"
            f"{total:10.1f}{outcome.slowest_s:11.3f}{outcome.peak_bytes / 2**20:14.1f}"
            f"{peak:13.0f}  slowest: {outcome.slowest}"
        )
        failed |= outcome.slowest_s > SLOWEST_S or peak > PROCESS_MIB
        failed |= outcome.peak_bytes > ONE_LOAD_MIB * 2**20
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
