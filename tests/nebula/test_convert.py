"""``nebula convert``: what goes in comes out, nothing is lost unsaid, and simulating agrees."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from gaussians.cameras import Display
from gaussians.constants import SH_C0
from gaussians.errors import InputError
from gaussians.formats import load_scene, save_scene, write_ply
from gaussians.placement import auto_view
from gaussians.scene import FIELDS, Scene
from gaussians.synthetic import generate_city
from gaussians.transforms import transformed, up_rotation
from lod_cloud import SearchRequest, build_tree, flat_search
from nebula.convert import SUFFIXES, run
from nebula.options import ConvertOptions, scene_options
from nebula.program import main
from nebula.report import stable_part
from tests.gaussians.real_data import data_file
from tests.gaussians.test_transforms import random_scene


def convert(source: Path, out: Path, **given) -> dict:
    """Run the command; scene options and its own ones may be given in any mix."""
    own = {"crop": None, "decimate_tau_px": None, "sh_degree": None, "new_up": None, "clamp": False}
    own = {key: given.pop(key, value) for key, value in own.items()}
    scene = scene_options(None, {"scene": str(source), **given})
    return run(ConvertOptions(scene=scene, out=out, **own)).data


def assert_same_bits(first: Scene, second: Scene) -> None:
    for field in FIELDS:
        one, other = getattr(first, field), getattr(second, field)
        assert one.shape == other.shape and np.array_equal(one, other), field


@pytest.fixture(scope="module")
def city(tmp_path_factory) -> tuple[Path, str]:
    """A city of 2 000 leaves as PLY, and the view of its street."""
    made = generate_city(2000, 7)
    path = tmp_path_factory.mktemp("city") / "city.ply"
    write_ply(made.scene, path)
    view = ":".join(",".join(f"{c:g}" for c in point) for point in (made.eye, made.target))
    return path, view


@pytest.fixture(scope="module")
def blob(tmp_path_factory) -> tuple[Path, Scene]:
    """400 random Gaussians of degree 3, as PLY and as read from it."""
    path = tmp_path_factory.mktemp("blob") / "blob.ply"
    write_ply(random_scene(np.random.default_rng(5), 400, 3), path)
    return path, load_scene(path)[0]


# ---------------------------------------------------------------- round trips


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3))
def test_ply_to_ply_keeps_every_bit_of_the_scene(tmp_path_factory, seed: int, degree: int) -> None:
    """Any stored float32 parameters, long logits and tiny scales and unnormalised quaternions too:
    the scene read from them, written and read again is the same bits in every field.
    """
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("trip")
    write_ply(random_scene(rng, 100, degree), folder / "a.ply")
    header, end, _ = (folder / "a.ply").read_bytes().partition(b"end_header\n")
    columns = header.count(b"property")
    table = rng.normal(size=(100, columns)) * 10.0 ** rng.uniform(-3, 1.5, (100, columns))
    table[:, -7:-4] = rng.uniform(-105, 40, (100, 3))  # logarithms of scales
    table[:50, -8] = rng.uniform(-3, 3, 50)  # logits
    (folder / "a.ply").write_bytes(header + end + table.astype("<f4").tobytes())
    convert(folder / "a.ply", folder / "b.ply")
    convert(folder / "b.ply", folder / "c.ply")
    assert_same_bits(load_scene(folder / "a.ply")[0], load_scene(folder / "b.ply")[0])
    assert (folder / "b.ply").read_bytes() == (folder / "c.ply").read_bytes()


def simulated(source: Path, view: str, out: Path) -> tuple[dict, np.ndarray]:
    """Report and left image of the last of three frames."""
    line = f"--scene {source} --up +z --view {view} --trace walk --frames 3 --search-every 2"
    line += f" --seed 3 --width 96 --height 80 --latency-ms 5 --out {out} --no-html"
    with pytest.raises(SystemExit) as end:
        main(["simulate", *line.split()])
    assert not end.value.code
    image = np.asarray(Image.open(out / "left.png"), np.float64)
    return json.loads((out / "report.json").read_text()), image


@pytest.fixture(scope="module")
def city_run(city, tmp_path_factory) -> tuple[dict, np.ndarray]:
    return simulated(*city, tmp_path_factory.mktemp("run"))


def comparable(report: dict) -> dict:
    """What must not depend on the name or the bytes of the file."""
    stable = stable_part(report)
    del stable["provenance"]["inputs"], stable["scene"]["name"]
    return stable


def test_simulating_a_converted_ply_gives_the_same_report(city, city_run, tmp_path) -> None:
    path, view = city
    convert(path, tmp_path / "copy.ply")
    report, image = simulated(tmp_path / "copy.ply", view, tmp_path / "out")
    assert comparable(report) == comparable(city_run[0])
    assert report["scene"]["name"] == "copy.ply"
    assert np.array_equal(image, city_run[1])


@pytest.mark.parametrize(("suffix", "least_psnr_db"), [(".splat", 50.0), (".spz", 42.0)])
def test_simulating_a_lossy_copy_stays_close(
    suffix: str, least_psnr_db: float, city, tmp_path
) -> None:
    """Both copies without harmonics above degree 0, so that only the lossy coding differs."""
    path, view = city
    runs = []
    for name in ("exact.ply", f"lossy{suffix}"):
        convert(path, tmp_path / name, sh_degree=0, clamp=True)
        runs.append(simulated(tmp_path / name, view, tmp_path / f"{name}.out"))
    (exact, image), (lossy, close) = runs
    assert lossy["lod"]["nodes"] == exact["lod"]["nodes"]
    assert lossy["stereo"]["right_mismatching_pixels"] == 0
    for group, key in (("timing", "cycles_per_frame"), ("energy", "total_mj_per_frame")):
        assert lossy[group][key] == pytest.approx(exact[group][key], rel=0.01)
    psnr_db = 10 * np.log10(255**2 / np.mean((image - close) ** 2))
    assert least_psnr_db < psnr_db < 70


def test_lossy_formats_stay_inside_their_stated_errors(blob, tmp_path) -> None:
    """The figures are those of the writers' docstrings."""
    path, scene = blob
    convert(path, tmp_path / "a.spz", clamp=True)
    spz, _ = load_scene(tmp_path / "a.spz")
    assert np.abs(spz.means - scene.means).max() <= max(np.abs(scene.means).max() / 8e6, 6e-8)
    assert np.abs(spz.opacities - scene.opacities).max() <= 0.00197
    assert (
        np.abs(spz.sh[:, 0] - scene.sh[:, 0]).max(where=scene.sh[:, 0] < 3.33, initial=0) <= 0.0131
    )
    assert np.abs(spz.sh[:, 1:] - scene.sh[:, 1:]).max() <= 1 / 256
    assert np.abs(np.log(spz.scales / scene.scales)).max() <= 1 / 32 + 1e-6
    assert same_up_to_sign(spz.quaternions, scene.quaternions, 0.0022)

    convert(path, tmp_path / "a.splat", sh_degree=0, clamp=True)
    splat, _ = load_scene(tmp_path / "a.splat")
    assert np.array_equal(splat.means, scene.means) and np.array_equal(splat.scales, scene.scales)
    assert np.abs(splat.opacities - scene.opacities).max() <= 0.00197
    colours = [(0.5 + SH_C0 * s.sh[:, 0]).clip(0, 1) for s in (splat, scene)]
    assert np.abs(colours[0] - colours[1]).max() <= 0.00197
    assert same_up_to_sign(splat.quaternions, scene.quaternions, 0.008)


def same_up_to_sign(first: np.ndarray, second: np.ndarray, error: float) -> bool:
    sign = np.where((first * second).sum(axis=1) < 0, -1, 1)[:, None]
    return bool(np.abs(first * sign - second).max() <= error)


# ---------------------------------------------------------------- what the options do


def test_a_crop_counts_what_it_leaves_out(blob, tmp_path) -> None:
    path, scene = blob
    data = convert(path, tmp_path / "part.ply", crop="-0.3,-9,-9:9,9,9")
    kept = scene.take(np.flatnonzero(scene.means[:, 0] >= np.float64(-0.3)))
    assert_same_bits(load_scene(tmp_path / "part.ply")[0], kept)
    assert data["gaussians"] == {
        "read": 400,
        "outside_crop": 400 - len(kept),
        "written": len(kept),
    }
    with pytest.raises(InputError, match=r"no Gaussian lies in the crop box; means go from \(-1\."):
        convert(path, tmp_path / "none.ply", crop="5,5,5:6,6,6")
    assert not (tmp_path / "none.ply").exists()


def test_harmonics_are_dropped_not_invented(blob, tmp_path) -> None:
    path, scene = blob
    data = convert(path, tmp_path / "flat.ply", sh_degree=1)
    assert data["sh_degree"] == {"read": 3, "written": 1}
    assert np.array_equal(load_scene(tmp_path / "flat.ply")[0].sh, scene.sh[:, :4])
    with pytest.raises(InputError, match=r"SH degree must lie in 0\.\.1 of the scene, not 2"):
        convert(tmp_path / "flat.ply", tmp_path / "more.ply", sh_degree=2)


def test_decimation_is_the_cut_at_the_automatic_or_the_given_view(blob, tmp_path) -> None:
    path, scene = blob
    tree = build_tree(scene)
    for view in (None, "0,-1,4:0,0,0"):
        eye = auto_view(scene, "-y")[0] if view is None else (0, -1, 4)
        data = convert(path, tmp_path / "cut.ply", decimate_tau_px=60.0, view=view, clamp=True)
        focal = Display.from_fov(1024, 1024, 96.0).fx
        ids = flat_search(tree, SearchRequest(eye, focal, 60.0)).node_ids
        cut = tree.gaussians.take(ids)
        written, _ = load_scene(tmp_path / "cut.ply")
        assert len(written) == len(ids) == data["gaussians"]["written"] < 300
        assert np.array_equal(written.means, cut.means)
        assert np.abs(written.opacities - np.minimum(cut.opacities, 1)).max() < 1e-7
        merged = int((tree.leaf_id[ids] < 0).sum())
        assert data["decimation"]["merged"] == merged > 0 and data["decimation"]["leaves"] == 400
        assert data["clamped"].get("opacities above 1", 0) == (cut.opacities > 1).sum()


def test_what_a_format_cannot_hold_is_an_error_or_a_count(blob, tmp_path) -> None:
    path, scene = blob
    opaque = Scene(*(getattr(scene, f) for f in FIELDS[:3]), np.full(400, 0.95, "f4"), scene.sh)
    save_scene(opaque, tmp_path / "opaque.ply")
    out = tmp_path / "cut.ply"
    out.write_bytes(b"before")
    with pytest.raises(InputError, match=r"cut.ply: .ply cannot hold \d+ opacities above 1 .*--cl"):
        convert(tmp_path / "opaque.ply", out, decimate_tau_px=60.0)
    assert out.read_bytes() == b"before"
    data = convert(tmp_path / "opaque.ply", out, decimate_tau_px=60.0, clamp=True)
    assert data["clamped"]["opacities above 1"] > 0
    assert load_scene(out)[0].opacities.max() == 1
    with pytest.raises(InputError, match=r"the scene has degree 3; give --sh-degree 0 to drop"):
        convert(path, tmp_path / "a.splat")
    with pytest.raises(InputError, match=r"\.splat cannot hold \d+ colours outside 0\.\.1; give"):
        convert(path, tmp_path / "a.splat", sh_degree=0)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.ply", "opaque.ply"]


def test_a_change_of_the_up_axis_turns_everything(blob, tmp_path) -> None:
    path, scene = blob
    data = convert(path, tmp_path / "up.ply", up="-y", new_up="+z")
    turned, _ = load_scene(tmp_path / "up.ply")
    expected = transformed(scene, up_rotation("-y", "+z"))
    assert np.array_equal(turned.means, expected.means)
    assert np.array_equal(turned.sh, expected.sh)
    assert np.array_equal(turned.quaternions, expected.quaternions)
    assert data["turn"] == {"from": "-y", "to": "+z", "rotation": data["turn"]["rotation"]}
    assert np.array_equal(data["turn"]["rotation"], up_rotation("-y", "+z"))


# ---------------------------------------------------------------- files


def test_the_input_is_never_overwritten(blob, tmp_path) -> None:
    path, _ = blob
    content = path.read_bytes()
    (tmp_path / "link.ply").symlink_to(path)
    for out in (path, tmp_path / "link.ply"):
        with pytest.raises(InputError, match="must not be a file of the scene that is read"):
            convert(path, out)
    assert path.read_bytes() == content and (tmp_path / "link.ply").is_symlink()


@pytest.mark.parametrize(
    ("out", "given", "message"),
    [
        ("a.sog", {}, "must end in one of .ply, .splat, .spz"),
        ("a", {}, "must end in one of"),
        ("folder.ply", {}, "must be a file, but a directory stands there"),
        ("a.splat", {"sh_degree": 1}, "holds no spherical harmonics; give --sh-degree 0"),
        ("a.ply", {"crop": "1,2"}, "box must be X0,Y0,Z0:X1,Y1,Z1"),
        ("a.ply", {"level": 1}, "only lod-meta.json has levels"),
    ],
)
def test_what_cannot_be_done_is_refused(
    out: str, given: dict, message: str, blob, tmp_path
) -> None:
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(InputError, match=message):
        convert(blob[0], tmp_path / out, **given)
    assert [p.name for p in tmp_path.rglob("*")] == ["folder.ply"]


def test_every_suffix_can_be_written_and_read(blob, tmp_path) -> None:
    for suffix in SUFFIXES:
        out = tmp_path / "new" / f"a{suffix}"
        data = convert(blob[0], out, sh_degree=0, clamp=True)
        assert len(load_scene(out)[0]) == 400
        assert (data["bytes"], data["format"]) == (out.stat().st_size, suffix[1:])
    assert len(list((tmp_path / "new").iterdir())) == len(SUFFIXES)


# ---------------------------------------------------------------- command line


def run_main(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main(["convert", *map(str, arguments)])
    return int(end.value.code or 0)


def test_the_command_line_says_what_it_did(blob, tmp_path, capsys) -> None:
    path, _ = blob
    options = ["--crop", "-1,-1,-1:1,1,1", "--sh-degree", "0", "--up", "-y:+z", "--clamp"]
    options += ["--decimate-tau", "60", "--view", "0,-1,4:0,0,0", "--fov", "60"]
    target = tmp_path / "result.json"
    assert run_main(path, tmp_path / "a.spz", *options, "--json", target) == 0
    text = capsys.readouterr().out
    data = json.loads(target.read_text())
    counts = data["gaussians"]
    assert counts["read"] == 400 and 0 < counts["outside_crop"] < 100
    for line in (
        "blob.ply: 400 Gaussians, harmonics of degree 3",
        f"crop: {counts['outside_crop']} outside, left out",
        "harmonics: degree 3 cut to 0",
        "decimation at 60 px seen from (0, -1, 4) with f = 887 px: "
        f"{400 - counts['outside_crop']} to {counts['written']}, ",
        "turned: up was -y, is +z",
        f"a.spz: {counts['written']} Gaussians, {data['bytes']} bytes",
    ):
        assert line in text
    assert data["inputs"][0]["name"] == "blob.ply" and data["decimation"]["tau_px"] == 60


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--up", "-y"], "--up must be FROM:TO with two of +x, -x"),
        (["--up", "-y:z"], "--up must be FROM:TO"),
        (["--view", "0,0,1:0,0,0", "--width", "9"], "--view, --width: of use for --decimate-tau"),
        (["--sh-degree", "4"], "4 is not in the range 0<=x<=3"),
        (["--decimate-tau", "-1"], "-1.0 is not in the range x>=0"),
        (["--crop", "0,0,0:-1,1,1"], "may exceed"),
    ],
)
def test_wrong_options_are_one_line(
    options: list[str], message: str, blob, tmp_path, capsys
) -> None:
    assert run_main(blob[0], tmp_path / "a.ply", *options) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.real_data
def test_a_level_of_a_real_set_is_converted(tmp_path) -> None:
    source = data_file("scenes/playbot_lod")
    data = convert(source, tmp_path / "coarse.ply", level=4)
    read, _ = load_scene(source, 4)
    assert data["gaussians"]["written"] == len(read) == 8406
    written, _ = load_scene(tmp_path / "coarse.ply")
    assert np.array_equal(written.means, read.means) and np.array_equal(written.sh, read.sh)
    assert np.array_equal(written.quaternions, read.quaternions)
    assert np.abs(written.opacities - read.opacities).max() <= 5e-8
    convert(tmp_path / "coarse.ply", tmp_path / "again.ply")
    assert_same_bits(load_scene(tmp_path / "again.ply")[0], written)
