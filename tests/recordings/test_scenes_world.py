"""The world of a folder in the layout of 7-Scenes: y down in its files, z up in a recording."""

import numpy as np
from PIL import Image

from steelnb.recordings.formats import open_recording, save_recording


def folder_of(path, poses):
    path.mkdir()
    for k, pose in enumerate(poses):
        Image.fromarray(np.full((480, 640), 1500, np.uint16)).save(path / f"frame-{k:06d}.depth.png")
        np.savetxt(path / f"frame-{k:06d}.pose.txt", pose)
    return path


def moved(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def test_a_camera_that_rises_goes_up_and_one_that_is_level_stays_level(tmp_path):
    poses = open_recording(folder_of(tmp_path / "scene", [moved(0, 0, 0), moved(0.1, -0.2, 0.3)])).poses
    np.testing.assert_allclose(poses.position[1], [0.3, -0.1, 0.2], atol=1e-12)
    np.testing.assert_allclose(poses.T_world_drone[:, :3, :3], np.eye(3)[None].repeat(2, axis=0), atol=1e-12)


def test_what_is_written_has_the_poses_that_were_read(tmp_path):
    turned = moved(0.1, -0.2, 0.3)
    turned[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    source = folder_of(tmp_path / "scene", [moved(0, 0, 0), turned])
    save_recording(tmp_path / "copy", open_recording(source), "7-scenes")
    for k in range(2):
        name = f"frame-{k:06d}.pose.txt"
        np.testing.assert_allclose(np.loadtxt(tmp_path / "copy" / name), np.loadtxt(source / name), atol=1e-12)
