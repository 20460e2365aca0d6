"""``python -m benchmarks.search_memory --tree DIR``: peak memory while a stored tree is searched.

Every method walks through the tree in a process of its own, which reports the most memory it ever
held (VmHWM of /proc/self/status: pages of mapped files count while they are mapped). Prints
Markdown and fails above the limit: 2 GiB for a directory of 8 GiB or more, else the same share of
its size on top of what Python and the compiled kernels need by themselves.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

GIB = 1 << 30
LIMIT_SHARE = 0.25  # of the directory: 2 GiB of 8
LIMIT_BYTES = 2 * GIB
METHODS = ("streaming", "wheel")
_BARE_BYTES = 400 << 20  # Python, NumPy, numba with its compiler
_STATUS = Path("/proc/self/status")


def peak_bytes() -> int:
    """The most memory this process ever held."""
    lines = _STATUS.read_text(encoding="utf-8").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def search(tree: Path, method: str, searches: int, every: int) -> dict[str, float]:
    """Walk through the tree in this process; ``peak_bytes`` and what says that it was a walk."""
    from benchmarks.searches import Subject  # compiles and imports what is measured
    from gaussians import parallel
    from lod_cloud import load_tree
    from lod_cloud.search import make_search

    parallel.set_threads(1)
    subject = Subject.of(str(tree), load_tree(tree))
    client = make_search(method, subject.tree)
    changes = 0
    for request in subject.requests("walk", every, 6.0, searches):
        result = client.search(request)
        changes += 0 if result.first else len(result.added)
    return {"peak_bytes": peak_bytes(), "cut_size": result.cut_size, "added": changes}


def measure(tree: Path, method: str, searches: int, every: int) -> dict[str, float]:
    """`search` in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.search_memory", "--tree", str(tree)]
    command += ["--searches", str(searches), "--every", str(every), "--inside", method]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def limit_bytes(tree: Path) -> int:
    """What a search of a directory may hold."""
    size = directory_bytes(tree)
    if size >= LIMIT_BYTES / LIMIT_SHARE:
        return LIMIT_BYTES
    return _BARE_BYTES + int(LIMIT_SHARE * size)


def directory_bytes(tree: Path) -> int:
    """Bytes of all files of a tree."""
    return sum(path.stat().st_size for path in tree.iterdir())


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print; exit code 1 above the limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tree", type=Path, required=True, metavar="DIR")
    parser.add_argument("--method", action="append", default=[], metavar="NAME")
    parser.add_argument("--searches", type=int, default=460)
    parser.add_argument("--every", type=int, default=4, metavar="W")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--inside", metavar="NAME", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.inside:
        print(json.dumps(search(given.tree, given.inside, given.searches, given.every)))
        return
    limit, size = limit_bytes(given.tree), directory_bytes(given.tree)
    print(f"{given.tree}: {size / GIB:.2f} GiB; a search may hold {limit / GIB:.2f} GiB\n")
    print("| method | peak GiB | cut | added on the walk | |\n|---|---:|---:|---:|---|")
    rows = []
    for method in given.method or METHODS:
        found = measure(given.tree, method, given.searches, given.every)
        passed = found["peak_bytes"] <= limit
        rows.append({"method": method, "limit_bytes": limit, "passed": passed, **found})
        cells = f"{found['peak_bytes'] / GIB:.2f} | {found['cut_size']} | {found['added']}"
        print(f"| {method} | {cells} | {'PASSED' if passed else 'FAILED'} |")
    if given.json:
        given.json.write_text(json.dumps({"tree": str(given.tree), "bytes": size, "rows": rows}))
    if not all(row["passed"] for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
