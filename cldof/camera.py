"""The camera: what turns metres into pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .files import read_json

__all__ = ["Camera"]

_MAX_SIDE_PX = 32768


def _number(value: Any, name: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"Camera {name} is {value!r}; it must be a number.") from None


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with square pixels; the lens is a :class:`~cldof.Lens` beside it.

    Parameters
    ----------
    width, height : int
        Image size in pixels.
    yfov_deg : float
        Full vertical field of view in degrees, 0 < yfov < 180.
    near, far : float
        Clipping distances in metres along the axis; ``far`` may be ``inf``.
    pose : array_like, (4, 4), optional
        Camera to world, rigid; x right, y up, looking along -z (OpenGL and glTF axes). Identity by default.

    Raises
    ------
    InputError
        For a zero-area image, an impossible angle or range, or a pose that is not a finite rigid transform.
    """

    width: int
    height: int
    yfov_deg: float = 45.0
    near: float = 0.05
    far: float = math.inf
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            number = _number(value, name)
            if number != int(number if math.isfinite(number) else 0) or not 1 <= number <= _MAX_SIDE_PX:
                raise InputError(
                    f"Camera {name} is {value!r}; it must be a whole number of pixels, 1 to {_MAX_SIDE_PX}."
                )
            object.__setattr__(self, name, int(number))
        for name in ("yfov_deg", "near", "far"):
            object.__setattr__(self, name, _number(getattr(self, name), name))
        if not 0.0 < self.yfov_deg < 180.0:
            raise InputError(f"Camera yfov_deg is {self.yfov_deg}; it must lie between 0 and 180 degrees.")
        if not (0.0 < self.near < self.far and math.isfinite(self.near)):
            raise InputError(
                f"Camera near and far are {self.near} and {self.far} m; they must satisfy 0 < near < far, near finite."
            )
        try:
            pose = np.array(self.pose, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("Camera pose must be a 4x4 matrix of numbers.") from None
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise InputError(f"Camera pose must be a finite 4x4 matrix; got shape {pose.shape}.")
        rotation = pose[:3, :3]
        rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
        if not rigid or not np.allclose(pose[3], (0, 0, 0, 1)):
            raise InputError(
                "Camera pose must be rigid (a rotation and a translation, no scale); "
                "orthonormalise its upper left 3x3 and set the last row to 0 0 0 1."
            )
        pose.setflags(write=False)
        object.__setattr__(self, "pose", pose)

    @classmethod
    def from_intrinsics(
        cls, fx: float, fy: float, cx: float, cy: float, width: int, height: int, **rest: Any
    ) -> Camera:
        """Build from pinhole intrinsics in pixels.

        Pixels must be square (``fx == fy`` within 0.1 %) and the principal point central (within half a pixel):
        the circle of confusion is a circle only then, and the capture frustum is symmetric.
        """
        fx, fy, cx, cy = (_number(v, n) for v, n in ((fx, "fx"), (fy, "fy"), (cx, "cx"), (cy, "cy")))
        if not (fx > 0 and fy > 0 and math.isfinite(fx) and math.isfinite(fy)):
            raise InputError(f"Camera fx and fy are {fx} and {fy} px; both must be positive and finite.")
        if abs(fx - fy) > 1e-3 * fy:
            raise InputError(f"Camera fx = {fx} and fy = {fy} px differ: resample the image to square pixels first.")
        if not (abs(cx - width / 2) <= 0.5 and abs(cy - height / 2) <= 0.5):
            raise InputError(
                f"Camera principal point ({cx}, {cy}) is off the centre ({width / 2}, {height / 2}) by more than half "
                "a pixel: crop or pad the image so that it is central."
            )
        return cls(width, height, math.degrees(2.0 * math.atan(height / (2.0 * fy))), **rest)

    @classmethod
    def from_sensor(
        cls, focal_length_mm: float, sensor_height_mm: float, width: int, height: int, **rest: Any
    ) -> Camera:
        """Build from a focal length and a sensor height in mm (24 mm is a full-frame sensor in landscape)."""
        focal, sensor = _number(focal_length_mm, "focal_length_mm"), _number(sensor_height_mm, "sensor_height_mm")
        if not (0 < focal < math.inf and 0 < sensor < math.inf):
            raise InputError(
                f"Camera focal length and sensor height are {focal} and {sensor} mm; both must be positive."
            )
        return cls(width, height, math.degrees(2.0 * math.atan(sensor / (2.0 * focal))), **rest)

    @property
    def focal_px(self) -> float:
        """Distance of the image plane in pixels, ``H / (2 tan(yfov / 2))``."""
        return self.height / (2.0 * math.tan(math.radians(self.yfov_deg) / 2.0))

    def with_guard(self, guard_px: int) -> Camera:
        """The same camera seeing ``guard_px`` more pixels on each side; pixel size and pose stay."""
        height = self.height + 2 * guard_px
        yfov = math.degrees(2.0 * math.atan(height / (2.0 * self.focal_px)))
        return replace(self, width=self.width + 2 * guard_px, height=height, yfov_deg=yfov)

    def supersampled(self, factor: int) -> Camera:
        """The same view with ``factor`` times as many pixels each way."""
        return replace(self, width=self.width * factor, height=self.height * factor)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, as a camera file holds them."""
        return {
            "width": self.width,
            "height": self.height,
            "yfov_deg": self.yfov_deg,
            "znear": self.near,
            "zfar": self.far if math.isfinite(self.far) else None,
            "pose_camera_to_world": self.pose.tolist(),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any], width: int | None = None, height: int | None = None) -> Camera:
        """Read what :meth:`to_dict` wrote; ``width`` and ``height`` override or supply the size."""
        if not isinstance(data, dict):
            raise InputError(f"A camera description must be a JSON object, not {type(data).__name__}.")
        known = {"width", "height", "yfov_deg", "znear", "zfar", "pose_camera_to_world"}
        unknown = sorted(set(data) - known)
        if unknown:
            raise InputError(f"Camera description has unknown keys {unknown}; known are {sorted(known)}.")
        if "yfov_deg" not in data:
            raise InputError("Camera description lacks yfov_deg (full vertical field of view in degrees).")
        optional: dict[str, Any] = {}
        if data.get("znear") is not None:
            optional["near"] = data["znear"]
        if data.get("zfar") is not None:
            optional["far"] = data["zfar"]
        if data.get("pose_camera_to_world") is not None:
            optional["pose"] = data["pose_camera_to_world"]
        return cls(
            width if width is not None else data.get("width", 0),
            height if height is not None else data.get("height", 0),
            data["yfov_deg"],
            **optional,
        )

    @classmethod
    def load(cls, path: str | Path, width: int | None = None, height: int | None = None) -> Camera:
        """Read a JSON camera file: ``yfov_deg``, ``pose_camera_to_world`` (4x4, glTF axes), ``znear``, ``zfar``."""
        data = read_json(path, f"camera file {path}")
        return cls.from_dict(data, width, height)
