"""Walk through a generated city and print what the cloud sends: bytes per message.

python examples/stream_a_walk.py --leaves 100000 --frames 48

The cloud searches the level-of-detail tree every four frames and sends what the client lacks.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from gaussians.cameras import DISPLAYS
from gaussians.errors import InputError
from gaussians.placement import anchor
from gaussians.poses import generate_trace
from gaussians.synthetic import generate_city
from lod_cloud import Client, Cloud, PaperCodec, SearchRequest, build_tree

RATE_HZ = 90.0


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--leaves", type=int, default=100_000, help="Gaussians of the city")
    parser.add_argument("--frames", type=int, default=48, help="of the walk, 90 per second")
    parser.add_argument("--tau", type=float, default=40.0, help="level of detail, pixels")
    options = parser.parse_args(argv)

    city = generate_city(options.leaves, seed=0)
    tree = build_tree(city.scene, up=(0.0, 0.0, 1.0))
    codec = PaperCodec.train(tree, seed=0, words=256, stages=4)
    cloud, client = Cloud(tree, codec, frames_per_search=4), Client()
    walk = generate_trace("walk", options.frames, np.random.default_rng(0))
    walk = anchor(walk, city.start, city.up)

    size = client.receive(cloud.session_start()).message_bytes
    print(f"{len(tree)} nodes for {tree.leaves} leaves; codebook and settings: {size} B")
    print(f"{'frame':>5} {'message, B':>11} {'new nodes':>10} {'held':>8} {'drawn':>8}")
    sent = 0
    for frame in range(0, options.frames, 4):
        x, y, z = walk.pose(frame).position
        request = SearchRequest((x, y, z), DISPLAYS["prototype"].fx, options.tau)
        received = client.receive(cloud.search(request, frame))
        cloud.receive(client.report())
        drawn = len(client.select(request).node_ids)
        sent += received.message_bytes if frame else 0  # the first one is the start-up
        new, held = received.payloads, received.held
        print(f"{frame:5} {received.message_bytes:11} {new:10} {held:8} {drawn:8}")
    seconds = options.frames / RATE_HZ
    print(f"after the first message: {sent * 8e-6 / seconds:.2f} Mbps over {seconds:.2f} s")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
