"""Damaged scene files, endlessly: the engine of the quick test and of ``benchmarks.fuzz_formats``.

First come truncations, at every byte of every packed file and of every part; then random damage to
bytes, header lines, JSON values and whole parts, and bombs. A reader must either load a mutated
scene or raise InputError with one short printable line.
"""

from __future__ import annotations

import json
import struct
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from gaussians.errors import InputError
from gaussians.formats import load_lod_set, load_scene
from tests.fuzz_targets import TARGETS, Parts, Target

MESSAGE_LIMIT = 1200  # characters; a path of the temporary folder takes up to a few hundred
_WORDS = [0, 1, 0x7F, 0x80, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7F800000, 0x7FC00000, 0x00800000]
_NUMBERS = ["0", "-1", "1", "2", "255", "65536", "2147483648", "4294967295", "9" * 18, "9" * 400]
_NUMBERS += ["1e9", "0x10", "nan", "1.5", "", "٣"]
_TOKENS = ["float", "double", "list", "uchar", "int", "uint", "short", "property", "element", "x"]
_TOKENS += ["vertex", "chunk", "sh", "f_rest_0", "opacity", "end_header", "comment", "ply", "\0"]
_TOKENS += ["binary_big_endian", "ascii", "1.0", "\x1b[31m", "\xff", "a" * 2000, "packed_scale"]
_PATHS = ["../x", "/etc/passwd", "..", ".", "a/../../b", "C:\\x", "a\0b", "\ud800", "a" * 5000]
_PATHS += ["meta.json", "lod-meta.json", "", "//", "~", "\n", "means_l.webp", "/dev/zero"]
_VALUES: list[object] = [None, True, -1, 0, 1, 2.5, 10**400, -(10**30), 1e308, 2**31, 2**63, "x"]
_VALUES += [[], {}, [None], {"a": 1}, [[[[]]]], "9" * 5000, *_PATHS]


@dataclass
class Outcome:
    """What a run of mutations did."""

    loaded: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    slowest: str = ""
    peak_bytes: int = 0  # most memory that one load held, while tracemalloc traces


def fuzz(target: str, mutations: int, seed: int, folder: Path) -> Outcome:
    """Load that many mutated files; anything but a scene or an InputError is raised at once.

    The message of the exception that ends a run names the mutation; the same arguments repeat it.
    At most half of the mutations are truncations, evenly spread where that is not every byte.
    """
    made = TARGETS[target]()
    outcome, rng = Outcome(), np.random.default_rng(seed)
    clean = made.pack(made.parts)
    _write(folder, clean)
    _load(target, folder / made.entry)
    cases = chain(_fixed_cases(made, mutations // 2), _random_cases(made, rng))
    for _, (name, files) in zip(range(mutations), cases, strict=False):
        changed = {path: content for path, content in files.items() if clean.get(path) != content}
        for path in clean.keys() - files.keys():
            (folder / path).unlink()
        _write(folder, changed)
        before = _traced(reset=True)
        started = time.perf_counter()
        try:
            outcome.loaded += _load(target, folder / made.entry)
        except InputError as error:
            _check_message(str(error), folder, name)
            outcome.refused += 1
        except BaseException as error:
            raise AssertionError(f"{target}, {name}: {type(error).__name__}: {error}") from error
        elapsed = time.perf_counter() - started
        if elapsed > outcome.slowest_s:
            outcome.slowest_s, outcome.slowest = elapsed, name
        outcome.peak_bytes = max(outcome.peak_bytes, _traced() - before)
        for path in changed.keys() - clean.keys():
            (folder / path).unlink()
        _write(folder, {p: c for p, c in clean.items() if p in changed or p not in files})
    return outcome


def _load(target: str, path: Path) -> bool:
    """Load with everything a reader promises of its result."""
    scenes = (
        load_lod_set(path).levels.values() if target == "lod_meta" else [load_scene(str(path))[0]]
    )
    for scene in scenes:
        assert len(scene.validate()) > 0
    return True


def _traced(reset: bool = False) -> int:
    """Peak of the traced memory so far, or what is held now and the peak starts anew; else 0."""
    if not tracemalloc.is_tracing():
        return 0
    if reset:
        tracemalloc.reset_peak()
    return tracemalloc.get_traced_memory()[0 if reset else 1]


def _check_message(message: str, folder: Path, name: str) -> None:
    text = message.replace(str(folder), "")
    if not text.isprintable() or len(text) > MESSAGE_LIMIT:
        raise AssertionError(f"{name}: must be one short line: {text[:MESSAGE_LIMIT]!r}")


def _write(folder: Path, files: Parts) -> None:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


# ---------------------------------------------------------------- mutations


def _fixed_cases(target: Target, truncations: int) -> Iterator[tuple[str, Parts]]:
    """Bombs, then truncations at every byte: of the packed files, then of the parts, repacked."""
    for number, files in enumerate(target.bombs):
        yield f"bomb {number}", files
    packed = target.pack(target.parts)
    parts = {} if packed == target.parts else target.parts
    total = sum(len(content) for content in (*packed.values(), *parts.values()))
    step = -(-total // max(truncations, 1))
    for name, content in packed.items():
        for end in range(0, len(content), step):
            yield f"{name} cut at {end}", {**packed, name: content[:end]}
    for name, content in parts.items():
        for end in range(0, len(content), step):
            yield f"part {name} cut at {end}", target.pack({**parts, name: content[:end]})


def _random_cases(target: Target, rng: np.random.Generator) -> Iterator[tuple[str, Parts]]:
    """Damage to parts (so that checksums hold) or to packed files, one to three times."""
    packed = target.pack(target.parts)
    for number in range(2**62):
        parts = dict(target.parts)
        done = []
        for _ in range(int(rng.integers(1, 4))):
            done.append(_damage_one(parts, rng))
        if rng.random() < 0.25:
            files = dict(packed)
            done = [_damage_one(files, rng)]
        else:
            files = target.pack(parts)
        yield f"random {number}: {', '.join(done)}", files


def _damage_one(parts: Parts, rng: np.random.Generator) -> str:
    """Change one part in place; returns what was done."""
    name = str(rng.choice(sorted(parts)))
    content = parts[name]
    choice = rng.random()
    if choice < 0.06 and len(parts) > 1:
        other = str(rng.choice(sorted(parts)))
        parts[name], parts[other] = parts[other], content
        return f"swap {name} and {other}"
    if choice < 0.10:
        parts[name] = [b"", bytes(64), b"ply\n", b"PK\x03\x04", b"RIFF", b"\x1f\x8b", b"{}"][
            int(rng.integers(7))
        ]
        return f"replace {name}"
    if choice < 0.12 and len(parts) > 1:
        del parts[name]
        return f"drop {name}"
    if name.endswith(".json") and choice < 0.85:
        parts[name] = _damaged_json(content, rng)
        return f"JSON of {name}"
    if name.endswith("header") and content.startswith(b"ply") and choice < 0.85:
        parts[name] = _damaged_lines(content, rng)
        return f"lines of {name}"
    parts[name] = _damaged_bytes(content, rng)
    return f"bytes of {name}"


def _damaged_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(content or b"\0")
    at = int(rng.integers(len(data)))
    length = int(rng.integers(1, 9))
    match int(rng.integers(8)):
        case 0:
            data[at] ^= 1 << int(rng.integers(8))
        case 1:
            data[at : at + length] = rng.bytes(length)
        case 2:
            data[at : at + 4] = struct.pack("<I", int(rng.choice(_WORDS)))
        case 3:  # the other byte order
            at -= at % 4
            data[at : at + 4] = data[at : at + 4][::-1]
        case 4:
            del data[at : at + length]
        case 5:
            data[at:at] = rng.bytes(length)
        case 6:
            data += data[at : at + 64]
        case 7:
            for position in rng.integers(len(data), size=8):
                data[position] = int(rng.integers(256))
    return bytes(data)


def _damaged_lines(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.decode("latin-1").split("\n")
    at, other = (int(i) for i in rng.integers(len(lines), size=2))
    words = lines[at].split(" ")
    match int(rng.integers(7)):
        case 0:
            del lines[at]
        case 1:
            lines.insert(other, lines[at])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case 3:
            words[int(rng.integers(len(words)))] = str(rng.choice([*_TOKENS, *_NUMBERS]))
            lines[at] = " ".join(words)
        case 4:
            words[-1] = str(rng.choice(_NUMBERS))
            lines[at] = " ".join(words)
        case 5:
            lines[at] = " ".join([*words, str(rng.choice(_TOKENS))])
        case 6:
            lines[at] += "\r" if rng.random() < 0.5 else " " * 2000
    return "\n".join(lines).encode("utf-8", "replace")


def _damaged_json(content: bytes, rng: np.random.Generator) -> bytes:
    try:
        document = json.loads(content)
    except ValueError:  # damaged before
        return _damaged_bytes(content, rng)
    holders = [node for node in _nodes(document) if node]
    if not holders:
        return _damaged_bytes(content, rng)
    holder = holders[int(rng.integers(len(holders)))]
    keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
    key = keys[int(rng.integers(len(keys)))]
    match int(rng.integers(6)):
        case 0:
            del holder[key]
        case 1 | 2:
            holder[key] = _VALUES[int(rng.integers(len(_VALUES)))]
        case 3 if isinstance(holder[key], int):
            holder[key] = int(holder[key]) + int(rng.integers(-2, 3))
        case 4 if isinstance(holder, list):
            holder.append(holder[key])
        case 5:  # a second member of the same name, or a constant that JSON does not have
            text = json.dumps(document)
            spare = '{"count": NaN, ' if rng.random() < 0.5 else '{"count": 3, "tree": 1, '
            return text.replace("{", spare, 1).encode()
        case _:
            holder[key] = [holder[key]] * int(rng.integers(2, 300))
    return json.dumps(document).encode()


def _nodes(document: object) -> Iterator[dict | list]:
    if isinstance(document, dict | list):
        yield document
        for child in document.values() if isinstance(document, dict) else document:
            yield from _nodes(child)
