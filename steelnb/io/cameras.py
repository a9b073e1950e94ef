"""Cameras of depth images: which CameraInfo holds for which image."""

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.io import messages as ros
from steelnb.io.containers import Container
from steelnb.io.headers import Headers
from steelnb.io.topics import camera_topic


class DepthCamera(NamedTuple):
    """A camera in a ``frame``, and the stamp from which its ``info`` holds."""

    begin_s: float
    frame: str
    info: ros.CameraInfo


def cameras_of(bag: Container, headers: Headers, topic: str) -> list[DepthCamera]:
    """The cameras of a topic's depth images, with notes on what is left out or contradicts. Raises `InputError`."""
    names = (topic, *headers.cameras)
    frame_of = {name: next(iter(headers.objects(name)))[0] for name in names}
    cameras = [DepthCamera(*each) for each in headers.cameras[camera_topic(bag, topic, frame_of)]]
    if "rect" in topic.rpartition("/")[2]:
        cameras = [each._replace(info=each.info.rectified()) for each in cameras]
    if len(cameras) > len({each.frame for each in cameras}):
        headers.note("the CameraInfo changes in flight; each image has that of its time")
    for frame in dict.fromkeys(each.frame for each in cameras):
        info = camera_at(cameras, frame, -np.inf)
        if info.distortion:
            headers.note(f"the lens's distortion ({info.distortion}) is left out")
        elif not np.allclose(info.K, info.rectified().K, rtol=1e-3):
            headers.note("P of the CameraInfo differs from K, which is used: images may be rectified")
        if headers.shape is not None:
            with suppress(InputError):  # it is the fault of each scan
                headers.note(*filter(None, ros.camera_matrix(info, *headers.shape)[1:]))
    return cameras


def camera_at(cameras: list[DepthCamera], frame: str, stamp_s: float) -> ros.CameraInfo:
    """The camera of an image: the latest in its frame or, if none is in it, of all; the first before any."""
    own = [each for each in cameras if each.frame == frame] or cameras
    return ([each for each in own if each.begin_s <= stamp_s] or own[:1])[-1].info
