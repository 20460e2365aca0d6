"""Where compiled kernels are kept between runs.

numba's disk cache notices a change of the file a kernel stands in, but not of a function that
kernel imports from another file. Kernels therefore call only functions of their own file or of the
files in ``SHARED_SOURCES``, and the cache folder is named after a hash of exactly those files.
"""

import hashlib
import os
import sys
from pathlib import Path

SHARED_SOURCES = (
    "gaussians/float32_math.py",
    "gaussians/footprints.py",
    "gaussians/lanes.py",
    "lod_cloud/criterion.py",
    "lod_cloud/moments.py",
    "lod_cloud/nodes.py",
    "lod_cloud/pairing.py",
    "lod_cloud/search/marks.py",
    "lod_cloud/search/prefetching.py",
    "lod_cloud/search/sectors.py",
    "lod_cloud/search/wheel_buckets.py",
    "lod_cloud/search_arrays.py",
)


def configure() -> Path:
    """Point numba's cache at a folder keyed on the shared kernel sources; return the folder.

    ``$NUMBA_CACHE_DIR`` stays the parent folder where it is set, else ``~/.cache/nebula/kernels``.
    Must run before the first cached kernel is defined; ``gaussians/__init__.py`` does it.
    """
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for name in SHARED_SOURCES:
        digest.update((root / name).read_bytes())
    cache_home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    parent = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_home / "nebula" / "kernels")
    folder = (
        parent
        if parent.name.startswith("shared-")
        else parent / f"shared-{digest.hexdigest()[:12]}"
    )
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return folder
