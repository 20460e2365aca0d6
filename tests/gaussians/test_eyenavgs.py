"""Recorded head traces (EyeNavGS)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussians.errors import InputError
from gaussians.poses import read_eyenavgs, resample
from tests.gaussians.real_data import data_file

HEADER = (
    "ViewIndex,FOV1,FOV2,FOV3,FOV4,PositionX,PositionY,PositionZ,QuaternionX,QuaternionY,"
    "QuaternionZ,QuaternionW,GazePosX,Timestamp"
)
LEFT = "0,-0.942,0.698,-0.942,0.733,1,2,3,0,0,0,1,0,{t}"
RIGHT = "1,-0.698,0.942,-0.942,0.733,1.03,2,3,0,0,0,1,0,{t}"
SETTING = 'Scene_Name,Quaternion,Scale,Initial_Position\npark,"0, 0, 0, 1",0.5,"0,0,0"\n'


def recording(folder: Path, *lines: str, name: str = "user7_park.csv") -> Path:
    path = folder / name
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    return path


def two_frames(folder: Path, name: str = "user7_park.csv") -> Path:
    lines = [row.format(t=t) for t in (100, 114) for row in (LEFT, RIGHT)]
    return recording(folder, *lines, name=name)


def test_eyenavgs_axes_units_and_baseline(tmp_path):
    (tmp_path / "scene_setting.csv").write_text("\ufeff" + SETTING)
    trace = read_eyenavgs(two_frames(tmp_path))
    assert (trace.name, trace.up, len(trace)) == ("user7_park", "+y", 2)
    assert trace.files == (tmp_path / "user7_park.csv", tmp_path / "scene_setting.csv")
    assert np.allclose(trace.times_s, [0, 0.014])
    # identity in OpenXR looks along -z with y up; half of 0.06 m to the right; 0.5 units per metre
    assert np.array_equal(trace.rotations[0], np.diag([1.0, -1, -1]))
    assert np.allclose(trace.positions, [[2.03, 4, 6]] * 2, atol=1e-12)
    assert trace.half_angles == (0.942, 0.698, 0.733, 0.942)  # outer, inner, up, down


def test_eyenavgs_gravity_turns_positions_and_axes(tmp_path):
    quarter = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # about x: y to z, z to -y
    trace = read_eyenavgs(two_frames(tmp_path), scale=1.0, gravity_quaternion=quarter)
    assert trace.files == (tmp_path / "user7_park.csv",)
    assert np.allclose(trace.positions[0], [1.015, -3, 2], atol=1e-12)
    assert np.allclose(trace.rotations[0], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


def test_eyenavgs_settings_are_also_found_one_folder_up(tmp_path):
    (tmp_path / "park").mkdir()
    (tmp_path / "scene_setting.csv").write_text(SETTING)
    trace = read_eyenavgs(two_frames(tmp_path / "park"), gravity_quaternion=(0, 0, 1, 0))
    assert np.allclose(trace.positions[0], [-2.03, -4, 6], atol=1e-12)


@pytest.mark.parametrize(
    ("setting", "name", "message"),
    [
        (None, "user7_park.csv", r"needs the scene's scale and gravity .* scene_setting\.csv"),
        (SETTING, "user7_lake.csv", "must have one row for the scene 'lake', not 0"),
        (SETTING, "park.csv", "the file name must end in _SCENE.csv"),
        (
            SETTING.replace("0.5", "half"),
            "user7_park.csv",
            "Scale must be a finite number, not 'half'",
        ),
        (SETTING.replace("0.5", "0"), "user7_park.csv", "scale must be a positive number, not 0"),
        (SETTING.replace("0, 1", "1"), "user7_park.csv", "Quaternion must be four numbers, not 3"),
        (SETTING.replace("0, 1", "0, 2"), "user7_park.csv", r"length 1 within 0\.01, not 2"),
        (SETTING.replace("Scale", "Size"), "user7_park.csv", "missing column Scale"),
    ],
)
def test_missing_eyenavgs_settings_say_what_is_needed(tmp_path, setting, name, message):
    if setting:
        (tmp_path / "scene_setting.csv").write_text(setting)
    with pytest.raises(InputError, match=message):
        read_eyenavgs(two_frames(tmp_path, name))


A, B = LEFT.format(t=0), RIGHT.format(t=3)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "at least one frame"),
        ([A], "alternate between 0"),
        ([B, A], "alternate between 0"),
        ([A, B, A, B], "times must increase; frame 1 does not"),
        ([A[:-4], B], "row 1 must have 14 cells"),
        ([A + ",1", B], "row 1 must have 14 cells"),
        ([A, B.replace("1.03", "x")], "row 2: PositionX must be a finite number, not 'x'"),
        ([A, B.replace("1.03", "nan")], "row 2: PositionX must be a finite number, not 'nan'"),
        ([A.replace("0,0,0,1,", "0,0,0,0,"), B], "quaternions must have length 1"),
        ([A.replace("0.698", "0.7"), B], "mirrored between the eyes"),
        (
            [A.replace("-0.942,0.733", "0.942,0.733"), B.replace("-0.942", "0.942")],
            "opposite signs",
        ),
    ],
)
def test_damaged_recordings_are_refused(tmp_path, lines, message):
    with pytest.raises(InputError, match=message):
        read_eyenavgs(recording(tmp_path, *lines), 1.0, (0.0, 0.0, 0.0, 1.0))


def test_a_recording_that_is_not_text_is_refused(tmp_path):
    (tmp_path / "a_park.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="must be a UTF-8 text file"):
        read_eyenavgs(tmp_path / "a_park.csv")
    (tmp_path / "a_park.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="missing column ViewIndex"):
        read_eyenavgs(tmp_path / "a_park.csv")


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "frames", "seconds", "extent_m"),
    [
        ("user110_london", 5466, 77.4, 2.7),
        ("user103_nyc", 4652, 82.2, 2.7),
        ("user113_alameda", 4738, 95.6, 10.6),
    ],
)
def test_real_recordings_are_upright_walks(name, frames, seconds, extent_m):
    trace = read_eyenavgs(data_file(f"traces/eyenavgs/{name}.csv"))
    assert len(trace) == frames
    assert abs(trace.times_s[-1] - seconds) < 0.1
    assert abs(np.ptp(trace.positions, axis=0).max() - extent_m) < 0.1
    assert np.ptp(trace.positions[:, 1]) < 0.75  # the vertical is the shortest direction
    assert trace.rotations[:, 1, 1].mean() < -0.9  # image-down points down
    roll = np.degrees(np.arcsin(trace.rotations[:, 1, 0]))
    assert np.abs(roll).mean() < 5  # the right axis stays nearly level
    speed = np.linalg.norm(np.diff(trace.positions, axis=0), axis=1) / np.diff(trace.times_s)
    assert np.percentile(speed, 99) < 3.0
    assert trace.half_angles == (0.942, 0.698, 0.733, 0.942)
    assert len(resample(trace, 90.0, 90 * int(seconds))) == 90 * int(seconds)
