"""``python -m benchmarks.first_picture --tree DIR``: how soon there is something sensible to see.

Connect at the tree's start, stand still until nothing is pending, harmonics neither, then jump
along the tree's path and stand still again, once per codec. Every message has at most the bytes the
link carries between two searches. For both occasions it prints when the client's cut was complete
at falling tau: by the bytes on the line alone, the same with the codebook, which is sent once
before, and from the request on, with latency both ways and the computing time of configs/session;
what search and coding took on this machine stands beside it, as CPU time of one thread. Goals at
100 Mbps on `dense_city`, by the line: 120 px within 60 ms, 60 px within 200 ms.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import machine
from gaussians.cameras import DISPLAYS
from gaussians.parallel import set_threads
from gaussians.poses import GENERATED_RATE_HZ
from lod_cloud import Cloud, Link, LodTree, SearchRequest, SearchTree, load_tree, make_search
from lod_cloud.codec import Codec, CompactCodec, PaperCodec
from nebula.session_config import load_session_config
from nebula.stream_measurement import Player, first_pictures

GOALS_S = {120.0: 0.060, 60.0: 0.200}
HYSTERESIS = 0.02
HEADS = ("tau px", "messages", "bytes", "nodes", "line ms", "line and codebook ms", "in all ms")


def measure(
    tree: LodTree, hot: SearchTree, codec: Codec, link: Link, jump_m: float, given: Any
) -> dict[str, Any]:
    """Both occasions for one codec."""
    interval_s = given.every / GENERATED_RATE_HZ
    cloud = Cloud(
        tree,
        codec,
        search=make_search("auto", hot, hysteresis=HYSTERESIS),
        frames_per_search=given.every,
        budget_bytes=link.bytes_in(interval_s),
    )
    player = Player(cloud, link, interval_s, 1e-3 * load_session_config().cloud.compute_ms)
    result: dict[str, Any] = {"codebook_bytes": player.codebook_bytes}
    for occasion, place in (("connect", 0.0), ("teleport", jump_m)):
        x, y, z = _along(tree, place)
        request = SearchRequest((x, y, z), DISPLAYS["prototype"].fx, given.tau)
        begin = len(player.rows)
        for _ in range(given.most_searches):
            player.play(request)
            row = player.rows[-1]
            if not row["pending"] + row["pending_harmonics"] and row["tau_px"] <= given.tau:
                break
        rows = player.rows[begin:]
        result[occasion] = {
            "pictures": first_pictures(rows, link, given.tau),
            "messages": len(rows),
            "bytes": sum(row["message_bytes"] for row in rows),
            "largest_message": max(row["message_bytes"] for row in rows),
            "nodes": sum(row["payloads"] for row in rows),
            "removed": sum(row["removed"] for row in rows),
            "held_max": max(row["held"] for row in rows),
            "pending_after": rows[-1]["pending"],
            "plain": sum(row["plain"] for row in rows),
            "plain_max": max(row["pending_harmonics"] for row in rows),
            "completed": sum(row["completed"] for row in rows),
            "completing_s": sum(
                link.transmission_s(r["message_bytes"]) for r in rows if r["completed"]
            ),
            "first_cloud_cpu_ms": rows[0]["cloud_cpu_ms"],
            "cloud_cpu_ms_p50": float(np.median([row["cloud_cpu_ms"] for row in rows])),
            "state_bytes": cloud.state_bytes,
        }
    return result


def _along(tree: LodTree, distance_m: float) -> tuple[float, float, float]:
    """The point so far along the tree's path."""
    path = np.array(tree.metadata.path)
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    x, y, z = (float(np.interp(distance_m, lengths, path[:, axis])) for axis in range(3))
    return x, y, z


def lines(codec: str, result: dict[str, Any], link: Link) -> list[str]:
    """Markdown."""
    text = []
    codebook_s = link.transmission_s(result["codebook_bytes"])
    for occasion in ("connect", "teleport"):
        found = result[occasion]
        text += [
            f"### {codec} codec, {occasion}",
            f"{found['messages']} messages of at most {found['largest_message']} B until "
            f"{found['pending_after']} nodes are pending: {found['bytes']} B, {found['nodes']} "
            f"nodes sent, {found['plain']} of them without harmonics (at most {found['plain_max']} "
            f"in the cut, {found['completed']} completed in {1e3 * found['completing_s']:.0f} ms), "
            f"{found['removed']} removed, at most {found['held_max']} held; cloud "
            f"{found['first_cloud_cpu_ms']:.0f} CPU ms for the first message, p50 "
            f"{found['cloud_cpu_ms_p50']:.0f}; "
            f"codebook {result['codebook_bytes']} B; state {found['state_bytes'] / 1e6:.0f} MB",
            "",
            "| " + " | ".join(HEADS) + " | goal |",
            "|---" * (len(HEADS) + 1) + "|",
        ]
        for picture in found["pictures"]:
            tau, line_s = picture["tau_px"], picture["line_s"]
            if line_s is None:
                text.append(f"| {tau:g} | " + "- | " * len(HEADS))
                continue
            goal = GOALS_S.get(tau)
            verdict = "" if goal is None else ("PASSED" if line_s <= goal else "FAILED")
            values = [str(picture[key]) for key in ("messages", "bytes", "nodes")]
            times = (line_s, line_s + codebook_s, picture["complete_s"])
            values += [f"{1e3 * t:.0f}" for t in times]
            text.append(f"| {tau:g} | " + " | ".join(values) + f" | {verdict} |")
        text.append("")
    return text


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tree", type=Path, required=True, metavar="DIR")
    parser.add_argument("--codec", action="append", choices=["paper", "compact"], default=[])
    parser.add_argument("--rate-mbps", type=float, default=100.0)
    parser.add_argument("--latency-ms", type=float, default=5.0, help="one way")
    parser.add_argument("--every", type=int, default=4, metavar="W", help="frames per search")
    parser.add_argument("--tau", type=float, default=6.0, metavar="PX")
    parser.add_argument("--jump", type=float, default=100.0, metavar="M", help="along the path")
    parser.add_argument("--most-searches", type=int, default=300)
    parser.add_argument("--words", type=int, help="of the codebook, if not the codec's own")
    parser.add_argument("--stages", type=int)
    parser.add_argument("--json", type=Path, metavar="FILE")
    given = parser.parse_args(arguments)
    set_threads(1)
    where = machine.describe()
    print(machine.in_words(where) + "\n")
    tree, link = load_tree(given.tree), Link(given.rate_mbps, given.latency_ms)
    hot = SearchTree.of(tree)
    results = {}
    for name in given.codec or ["paper", "compact"]:
        train = PaperCodec.train if name == "paper" else CompactCodec.train
        sizes = {"words": given.words, "stages": given.stages}
        codec = train(tree, 0, **{key: size for key, size in sizes.items() if size is not None})
        results[name] = measure(tree, hot, codec, link, given.jump, given)
        print("\n".join(lines(name, results[name], link)), flush=True)
    if given.json:
        given.json.write_text(json.dumps({"machine": where, "results": results}, indent=2))


if __name__ == "__main__":
    main()
