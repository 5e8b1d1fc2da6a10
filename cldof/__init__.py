"""cldof: depth of field for 3D scenes and RGBD layers, with OpenCL on any device."""

from importlib import import_module
from typing import Any

from .camera import Camera
from .errors import (
    BudgetWarning,
    BuildError,
    CaptureError,
    CldofError,
    DeviceError,
    FrameError,
    InputError,
    OutputError,
    SceneError,
)
from .frame import LayeredFrame
from .lens import Aperture, DiscAperture, GaussianAperture, ImageAperture, Lens, PolygonAperture
from .lighting import Ambient, DirectionalLight, Environment, Lighting, PointLight

__version__ = "0.1.0"

__all__ = [
    "Ambient",
    "Aperture",
    "BudgetWarning",
    "BuildError",
    "Camera",
    "CaptureError",
    "CldofError",
    "DeviceError",
    "DirectionalLight",
    "DiscAperture",
    "Environment",
    "FrameError",
    "GaussianAperture",
    "ImageAperture",
    "InputError",
    "LayeredFrame",
    "Lens",
    "Lighting",
    "OutputError",
    "PointLight",
    "PolygonAperture",
    "Renderer",
    "SceneError",
    "__version__",
]


def __getattr__(name: str) -> Any:
    # Imported on first use: `import cldof` has to work where OpenCL is not installed.
    if name == "Renderer":
        return import_module(".renderer", __name__).Renderer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
