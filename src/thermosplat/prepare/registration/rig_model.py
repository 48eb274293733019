"""The COLMAP model of both cameras: the photographs' model with the thermal camera added.

It is a sensor of the photographs' rigs where images are paired, and a rig of its own where they are not.
"""

from collections.abc import Mapping

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap

from thermosplat.prepare.capture_folder import LEADING, OTHER
from thermosplat.prepare.registration.rig_camera import RigCamera


def with_thermal(
    model: pycolmap.Reconstruction, camera: RigCamera, pairs: Mapping[str, str]
) -> pycolmap.Reconstruction:
    """The model of the photographs with a thermal image in the frame of each paired one.

    Args:
        model: Model whose rigs have a camera of the photographs each. Thermal images that it has already are left out.
        pairs: The thermal image of each photograph, both below their folders; without any there is no such camera.

    Returns:
        A model with ``rgb/...`` and ``thermal/...`` images; its points are those of the photographs.
    """
    made = pycolmap.Reconstruction()
    photographs = [image for _, image in sorted(model.images.items()) if image.has_pose and is_photograph(image)]
    lens, thermal_id = camera.colmap_camera(), 1 + max(image.camera_id for image in photographs)
    sensors: dict[int, pycolmap.sensor_t] = {}
    # a sensor belongs to one rig: each camera of the photographs has a thermal camera of its own, with the same lens
    for number, photograph_camera in enumerate(sorted({image.camera_id for image in photographs})):
        made.add_camera(model.cameras[photograph_camera])
        lens.camera_id = thermal_id + number
        rig = pycolmap.Rig(rig_id=photograph_camera)
        rig.add_ref_sensor(_sensor(photograph_camera))
        if pairs:
            made.add_camera(lens)
            rig.add_sensor(_sensor(lens.camera_id), camera.colmap_pose())
        made.add_rig(rig)
        sensors[photograph_camera] = _sensor(lens.camera_id)
    next_id = 1 + max(image.image_id for image in photographs)
    for photograph in photographs:
        frame = pycolmap.Frame(frame_id=photograph.image_id, rig_id=photograph.camera_id)
        frame.rig_from_world = photograph.cam_from_world()
        frame.add_data_id(pycolmap.data_t(_sensor(photograph.camera_id), photograph.image_id))
        image = pycolmap.Image(
            name=photograph.name,
            keypoints=np.array([point.xy for point in photograph.points2D]).reshape(-1, 2),
            camera_id=photograph.camera_id,
            image_id=photograph.image_id,
        )
        images, thermal = [image], pairs.get(photograph.name.removeprefix(f"{LEADING}/"))
        if thermal is not None:
            sensor = sensors[photograph.camera_id]
            frame.add_data_id(pycolmap.data_t(sensor, next_id))
            images.append(pycolmap.Image(name=f"{OTHER}/{thermal}", camera_id=sensor.id, image_id=next_id))
            next_id += 1
        made.add_frame(frame)
        for image in images:
            image.frame_id = frame.frame_id
            made.add_image(image)
        made.register_frame(frame.frame_id)
    for point_id, point in model.points3D.items():
        made.add_point3D_with_id(point_id, point)
        for element in point.track.elements:
            made.images[element.image_id].set_point3D_for_point2D(element.point2D_idx, point_id)
    return made


def with_unpaired(
    model: pycolmap.Reconstruction, lens: RigCamera, places: Mapping[str, pycolmap.Rigid3d]
) -> pycolmap.Reconstruction:
    """The model of the photographs with thermal images of other moments.

    Args:
        lens: The thermal camera, whose pose does not count.
        places: Poses by the images' files, world to camera.
    """
    made, camera = with_thermal(model, lens, {}), lens.colmap_camera()
    camera.camera_id = rig_id = 1 + max(made.cameras)
    made.add_camera(camera)
    rig = pycolmap.Rig(rig_id=rig_id)
    rig.add_ref_sensor(_sensor(camera.camera_id))
    made.add_rig(rig)
    first = 1 + max((*made.images, *made.frames))
    for image_id, (name, pose) in enumerate(sorted(places.items()), first):
        frame = pycolmap.Frame(frame_id=image_id, rig_id=rig_id)
        frame.rig_from_world = pose
        frame.add_data_id(pycolmap.data_t(_sensor(camera.camera_id), image_id))
        image = pycolmap.Image(name=f"{OTHER}/{name}", camera_id=camera.camera_id, image_id=image_id)
        image.frame_id = image_id
        made.add_frame(frame)
        made.add_image(image)
        made.register_frame(image_id)
    return made


def is_photograph(image: pycolmap.Image) -> bool:
    """An image of the first spectrum, by its folder."""
    return bool(image.name.startswith(f"{LEADING}/"))


def _sensor(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
