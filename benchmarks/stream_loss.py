"""What decoding a cut loses: pictures of it, decoded and not. Printed by `benchmarks.stream`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from gaussians.cameras import StereoRig
from gaussians.quality import psnr_db
from gaussians.render import render_mono
from gaussians.scene import Scene
from lod_cloud import (
    Client,
    Cloud,
    Codec,
    LodTree,
    SearchRequest,
    SearchTree,
    TreeEncoder,
    flat_search,
    make_search,
)
from lod_cloud.codec.axes import sorted_axes
from lod_cloud.lod_tree import Int32


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Views of one scene, and all leaves rendered from them."""

    tree: LodTree
    rigs: list[StereoRig]
    tau_px: float
    full: list[Any]
    hot: SearchTree

    @classmethod
    def of(cls, tree: LodTree, rigs: list[StereoRig], tau_px: float) -> Pictures:
        leaves = np.sort(tree.leaf_nodes())
        full = [
            render_mono(tree.gaussians.take(leaves[_in_sight(tree, leaves, rig)]), rig)[0]
            for rig in rigs
        ]
        return cls(tree, rigs, tau_px, full, SearchTree.of(tree))

    def request(self, rig: StereoRig) -> SearchRequest:
        """Focal length as on the display of 2064 pixels, of which this is a smaller picture."""
        x, y, z = (float(v) for v in rig.pose.position)
        return SearchRequest((x, y, z), rig.display.fx * 2064 / rig.display.width, self.tau_px)

    def psnr_db(self, scenes: Sequence[Scene], against: Sequence[Any]) -> list[float]:
        """Of every view."""
        return [
            psnr_db(render_mono(scene, rig)[0], image) or float("inf")
            for scene, rig, image in zip(scenes, self.rigs, against, strict=True)
        ]

    def score(self, scenes: Sequence[Scene], against: Sequence[Any]) -> str:
        """In words."""
        return _in_words(self.psnr_db(scenes, against))


def _in_sight(tree: LodTree, nodes: Int32, rig: StereoRig) -> Int32:
    """Places of the nodes that may show: spheres twice as large as 3 sigma reach into the view."""
    x, y, z = ((tree.gaussians.means[nodes] - rig.pose.position) @ rig.pose.rotation).T
    reach = 2.0 * tree.radius[nodes]
    display = rig.display
    seen = z > -reach
    for aside, side in ((x, display.width / display.fx), (y, display.height / display.fy)):
        seen &= np.abs(aside) - 0.5 * side * z <= np.hypot(1.0, 0.5 * side) * reach
    return np.flatnonzero(seen).astype(np.int32)


def _in_words(values: Sequence[float]) -> str:
    return f"{np.mean(values):6.2f} ({' '.join(f'{v:.1f}' for v in values)})"


def loss(
    pictures: Pictures, codecs: dict[str, Codec], *, fields: bool, walk: bool
) -> dict[str, dict[str, float]]:
    """Prints PSNR in dB; with ``fields`` of every field alone, too, with ``walk`` after one.
    Returns means by codec.
    """
    tree = pictures.tree
    rows: dict[str, dict[str, float]] = {}
    cuts = [flat_search(tree, pictures.request(rig)).node_ids for rig in pictures.rigs]
    seen = [_in_sight(tree, cut, rig) for cut, rig in zip(cuts, pictures.rigs, strict=True)]
    originals = [tree.gaussians.take(cut[places]) for cut, places in zip(cuts, seen, strict=True)]
    images = [
        render_mono(scene, rig)[0] for scene, rig in zip(originals, pictures.rigs, strict=True)
    ]
    print(f"cuts of {', '.join(str(len(cut)) for cut in cuts)} nodes of {len(tree)}")
    whole = pictures.psnr_db(originals, pictures.full)
    print(f"cut against all leaves          {_in_words(whole)}")
    for name, codec in codecs.items():
        encoder = TreeEncoder(tree, codec)
        decoded, escapes = [], 0
        for cut, places in zip(cuts, seen, strict=True):
            coded = encoder.encode(cut)
            escapes += coded.escapes
            decoded.append(codec.decode(coded.payload).gaussians.take(places))
        print(f"{name}: escapes {escapes / sum(len(cut) for cut in cuts):.2%}")
        cut_db = pictures.psnr_db(decoded, images)
        leaves_db = pictures.psnr_db(decoded, pictures.full)
        print(f"  decoded against the cut       {_in_words(cut_db)}")
        print(f"  decoded against all leaves    {_in_words(leaves_db)}")
        if codec.apart:
            bare = [_plain(scene) for scene in decoded]
            print(f"  the same without harmonics    {pictures.score(bare, images)}")
            print(f"    against all leaves          {pictures.score(bare, pictures.full)}")
        rows[name] = {
            "decoded_vs_cut_db": float(np.mean(cut_db)),
            "worst_view_db": float(np.min(cut_db)),
            "decoded_vs_leaves_db": float(np.mean(leaves_db)),
            "lost_vs_leaves_db": float(np.mean(whole) - np.mean(leaves_db)),
        }
        sorted_first = name != "paper"
        for label, some in FIELDS.items() if fields else ():
            mixed = [
                _mixed(one, other, some, sorted_first=sorted_first)
                for one, other in zip(originals, decoded, strict=True)
            ]
            if some != ("above",) or tree.sh_degree:
                print(f"    {label:12} alone          {pictures.score(mixed, images)}", flush=True)
        if not walk:
            continue
        walked, stats = _walked(pictures, encoder)
        print(
            f"  after a walk, {stats['merged']:.1%} of the cut merged by the client:"
            f" against the cut {pictures.score(walked, images)},"
            f" all leaves {pictures.score(walked, pictures.full)}",
            flush=True,
        )
    return rows


FIELDS = {
    "position": ("means",),
    "scale": ("scales",),
    "rotation": ("quaternions",),
    "opacity": ("opacities",),
    "colour": ("dc",),
    "harmonics": ("above",),
    "all but harmonics": ("means", "scales", "quaternions", "opacities", "dc"),
}


def _plain(scene: Scene) -> Scene:
    """As nodes come while tau is raised."""
    sh = scene.sh.copy()
    sh[:, 1:] = 0
    return dataclasses.replace(scene, sh=sh)


def _mixed(original: Scene, decoded: Scene, fields: Sequence[str], *, sorted_first: bool) -> Scene:
    """The original with some fields as decoded."""
    if sorted_first:  # the same Gaussians, with the axes in the order of the decoded ones
        scales, quaternions = sorted_axes(original.scales, original.quaternions)
        original = dataclasses.replace(
            original,
            scales=scales.astype(np.float32),
            quaternions=quaternions.astype(np.float32),
        )
    parts = {name: getattr(decoded, name) for name in fields if name not in ("dc", "above")}
    sh = original.sh.copy()
    if "dc" in fields:
        sh[:, 0] = decoded.sh[:, 0]
    if "above" in fields:
        sh[:, 1:] = decoded.sh[:, 1:]
    return dataclasses.replace(original, sh=sh, **parts)


def _walked(pictures: Pictures, encoder: TreeEncoder) -> tuple[list[Scene], dict[str, float]]:
    """What a client has at each view, having walked there from the one before and stepped back."""
    tree = pictures.tree
    cloud = Cloud(tree, encoder, search=make_search("wheel", pictures.hot))
    client = Client()
    client.receive(cloud.session_start())
    scenes, merged, frame = [], [], 0
    here = np.array(pictures.request(pictures.rigs[-1]).position)
    for rig in pictures.rigs:
        target = pictures.request(rig)
        there = np.array(target.position)
        for share in (0.0, 0.25, 0.5, 0.75, 0.9, 1.1, 1.3, 1.1, 1.0):
            x, y, z = here + share * (there - here)
            request = dataclasses.replace(target, position=(float(x), float(y), float(z)))
            client.receive(cloud.search(target if share == 1.0 else request, frame))
            cloud.receive(client.report())
            frame += 40
        assert client.table is not None
        cut = client.table.cut_ids
        scene = client._subgraph.records(cut).gaussians
        sent = encoder.codec.decode(encoder.encode(cut).payload).gaussians
        merged.append(float((scene.means != sent.means).any(axis=1).mean()))
        scenes.append(scene.take(_in_sight(tree, cut, rig)))
        here = there
    return scenes, {"merged": float(np.mean(merged))}
