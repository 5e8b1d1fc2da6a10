"""What a renderer takes: peeled layers of colour and depth, checked once, here."""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import Camera
from .errors import FrameError, OutputError
from .files import atomic_write, parse_json, read_arrays
from .lens import Lens
from .lighting import Environment, Lighting

__all__ = ["FINER", "LayeredFrame"]

FINER = 3
"""A finer frame has so many pixels for one, along x and y: odd, so that one of them stands in the middle."""

_FORMAT_VERSION = 1
_SURFACE_CHANNELS = {"normal": 3, "albedo": 3, "specular": 3, "shininess": None}
# What shading from elsewhere needs.
_SHADING = ("normal", "specular", "shininess")
# Highlights that turn by less than this share of their own width over the lens's radius count as those of the lens
# centre. What is left out is of second order in it: below 1 % of a highlight.
_LEAST_TURN = 0.1
# Peels may repeat a depth (coplanar surfaces, sky behind sky) but never come nearer by more than rounding.
_ORDER_TOLERANCE = 1e-6
# Nearer than any surface; products of inverse depths with CoC coefficients and scales fit float32.
_NEAREST_M = 1e-9
# A column whose layers let through less than this is closed: float32 rounding of blended alphas.
_OPAQUE_TOLERANCE = 1e-3


class LayeredFrame:
    """M layers of colour and depth seen by one pinhole camera, front to back.

    A slot with depth ``inf`` and alpha 0 is empty: nothing is there. Depth ``inf`` with alpha above 0 is sky. Arrays
    that are float32 and C-contiguous already are kept, not copied, and the frame holds read-only views: treat a frame
    as immutable and make a new one for new pixels, since renderers keep what they derived from it on the device.

    Parameters
    ----------
    color : array_like, (M, H, W, 4) or (H, W, 4); RGB with 3 channels counts as opaque
        Linear light, premultiplied by alpha, unbounded above.
    depth : array_like, (M, H, W) or (H, W)
        Planar view-space depth in metres, positive, ``inf`` for nothing there or sky; per pixel not decreasing with M.
    camera : Camera
        Its size is that of the image, without the guard band.
    guard_px : int
        The arrays reach this many pixels beyond the image on each side, so that light from outside the frame is right.
    normal, albedo, specular, shininess : array_like, optional
        Surface buffers: (M, H, W, 3) world-space unit normals (0 where there is none), (M, H, W, 3) diffuse
        reflectance, (M, H, W, 3) specular reflectance straight on (0: matte), (M, H, W) Phong exponents; linear.
    lighting : Lighting, optional
        With normal, specular and shininess it lets methods shade what is glossy from the points of the lens. ``color``
        is what the surfaces show the camera under this light; see docs/methods/multiview.md.

    Raises
    ------
    FrameError
        With the count of bad values and the first pixel that has one.
    """

    def __init__(
        self,
        color: ArrayLike,
        depth: ArrayLike,
        camera: Camera,
        *,
        guard_px: int = 0,
        normal: ArrayLike | None = None,
        albedo: ArrayLike | None = None,
        specular: ArrayLike | None = None,
        shininess: ArrayLike | None = None,
        lighting: Lighting | None = None,
    ) -> None:
        if not isinstance(camera, Camera):
            raise FrameError(f"LayeredFrame needs a cldof.Camera; got {type(camera).__name__}.")
        if isinstance(guard_px, bool) or not isinstance(guard_px, int | np.integer) or guard_px < 0:
            raise FrameError(f"guard_px is {guard_px!r}; it must be a whole number of pixels, at least 0.")
        self.camera = camera
        self.guard_px = int(guard_px)
        shape = (camera.height + 2 * self.guard_px, camera.width + 2 * self.guard_px)
        self.depth = _as_layers(depth, "depth", None, shape)
        color_array = _as_array(color, "color")
        if color_array.ndim >= 3 and color_array.shape[-1] == 3:
            color_array = np.concatenate([color_array, np.ones((*color_array.shape[:-1], 1), np.float32)], axis=-1)
        self.color = _as_layers(color_array, "color", 4, shape)
        layers = self.depth.shape[0]
        if self.color.shape[0] != layers:
            raise FrameError(f"color has {self.color.shape[0]} layers but depth has {layers}; they must match.")
        self.surface: dict[str, NDArray[np.float32]] = {}
        given = {"normal": normal, "albedo": albedo, "specular": specular, "shininess": shininess}
        for name, value in given.items():
            if value is not None:
                array = _as_layers(value, name, _SURFACE_CHANNELS[name], shape)
                if array.shape[0] != layers:
                    raise FrameError(f"{name} has {array.shape[0]} layers but depth has {layers}; they must match.")
                _refuse(~np.isfinite(array), name, "NaN or infinite values")
                self.surface[name] = array
        self.lighting = lighting
        self._finer: LayeredFrame | Callable[[], LayeredFrame] | None = None
        self._check_values()
        for array in (self.color, self.depth, *self.surface.values()):
            array.setflags(write=False)

    def _check_values(self) -> None:
        if not isinstance(self.lighting, Lighting | None):
            raise FrameError(f"lighting must be a cldof.Lighting; got {type(self.lighting).__name__}.")
        missing = [name for name in _SHADING if name not in self.surface]
        if self.lighting is not None and missing:
            raise FrameError(f"A frame with lighting needs {', '.join(missing)} too; give them or leave lighting out.")
        for name, low, high in (("specular", 0.0, 1.0), ("shininess", 0.0, np.inf)):
            if name in self.surface:
                array = self.surface[name]
                _refuse((array < low) | (array > high), name, f"values outside of {low:g} to {high:g}")
        # Comparisons with NaN are false, so each test is written to be true for good values.
        if not (self.depth > 0.0).all():
            _refuse(np.isnan(self.depth), "depth", "NaN values; use inf where nothing is there")
            _refuse(
                self.depth <= 0.0, "depth", "zero or negative values; depth is planar, in metres, positive in front"
            )
        nearest = np.float32(_NEAREST_M)
        if not (self.depth >= nearest).all():
            what = f"values below {_NEAREST_M:g} m, whose inverse overflows; depth is in metres"
            _refuse(self.depth < nearest, "depth", what)
        low, high = self.color.min(), self.color.max()
        if not (low >= 0.0 and high < np.inf):
            _refuse(~np.isfinite(self.color), "color", "NaN or infinite values")
            _refuse(self.color < 0.0, "color", "negative values; colour is linear light")
        alpha = self.color[..., 3]
        if not alpha.max() <= 1.0 + 1e-5:
            _refuse(alpha > 1.0 + 1e-5, "color", "alpha above 1; alpha is coverage, premultiplied into RGB")
        if self.layer_count > 1:
            nearer = self.depth[1:] < self.depth[:-1] * np.float32(1.0 - _ORDER_TOLERANCE)
            _refuse(nearer, "depth", "layers out of order; each must be at least as deep as the one before it", first=1)

    def with_finer(self, finer: LayeredFrame | Callable[[], LayeredFrame]) -> LayeredFrame:
        """This frame, which knows of the same view captured :data:`FINER` (3) times larger, guard band included.

        ``method="auto"`` renders from it where the pixels of the image are too coarse for the error that is asked for.

        Parameters
        ----------
        finer : LayeredFrame or callable
            A function is called once, when the finer frame is first needed, by the thread that renders.
        """
        known = copy.copy(self)
        known._finer = finer
        if isinstance(finer, LayeredFrame):
            known._check_finer(finer)
        return known

    @property
    def has_finer(self) -> bool:
        """Whether the same view is to be had captured larger: :meth:`with_finer`."""
        return self._finer is not None

    @property
    def finer(self) -> LayeredFrame:
        """The same view captured :data:`FINER` (3) times larger.

        Raises
        ------
        FrameError
            There is none, or it is not of this frame's view.
        """
        if self._finer is None:
            raise FrameError("This frame knows of no finer one; give it one by with_finer.")
        if not isinstance(self._finer, LayeredFrame):
            captured = self._finer()
            self._check_finer(captured)
            self._finer = captured
        return self._finer

    def _check_finer(self, finer: LayeredFrame) -> None:
        if not isinstance(finer, LayeredFrame):
            raise FrameError(f"A finer frame must be a LayeredFrame; got {type(finer).__name__}.")
        wanted, camera = self.camera.supersampled(FINER), finer.camera
        is_of_size = (camera.width, camera.height, finer.guard_px) == (
            wanted.width,
            wanted.height,
            FINER * self.guard_px,
        )
        if not (
            is_of_size and math.isclose(camera.yfov_deg, wanted.yfov_deg) and np.allclose(camera.pose, wanted.pose)
        ):
            found = f"{finer.camera.width}x{finer.camera.height} with a guard band of {finer.guard_px} px"
            raise FrameError(
                f"The finer frame is {found}; it must be {wanted.width}x{wanted.height} with {FINER * self.guard_px} "
                f"px, and of the same view: capture it with camera.supersampled({FINER})."
            )

    @property
    def layer_count(self) -> int:
        """M, the number of peeled layers."""
        return int(self.depth.shape[0])

    @property
    def height(self) -> int:
        """Rows of the arrays, guard band included."""
        return int(self.depth.shape[1])

    @property
    def width(self) -> int:
        """Columns of the arrays, guard band included."""
        return int(self.depth.shape[2])

    @cached_property
    def inverse_depth_range(self) -> tuple[float, float]:
        """Smallest and largest ``1/z`` (1/m) of all slots that are not empty; (0, 0) for an empty frame."""
        nearest = float(self.depth.min())
        finite = self.depth < np.inf
        if finite.all():
            return 1.0 / float(self.depth.max()), 1.0 / nearest
        sky = bool((self.color[..., 3][~finite] > 0.0).any())
        if not finite.any():
            return 0.0, 0.0
        farthest = float(self.depth.max(initial=0.0, where=finite))
        return (0.0 if sky else 1.0 / farthest), 1.0 / nearest

    @property
    def shown_inverse_depths(self) -> tuple[float, float]:
        """Smallest and largest ``1/z`` (1/m) of what the image shows, where the void is a surface at infinity."""
        farthest, nearest = self.inverse_depth_range
        return farthest if self.is_opaque else 0.0, nearest

    @cached_property
    def farthest_opaque(self) -> NDArray[np.float32]:
        """Inverse depth (1/m) of the farthest opaque slot of each pixel, (H, W); inf where there is none."""
        depth = np.where(self.color[..., 3] >= 1.0, self.depth, np.float32(0.0)).max(axis=0)
        with np.errstate(divide="ignore"):
            return np.asarray(np.float32(1.0) / depth)

    @cached_property
    def is_opaque(self) -> bool:
        """True when no pixel of the pinhole image lets the void behind the scene through."""
        transmittance = 1.0 - self.color[0, ..., 3]
        for layer in self.color[1:]:
            if not (transmittance > _OPAQUE_TOLERANCE).any():
                break
            transmittance = transmittance * (1.0 - layer[..., 3])
        return not bool((transmittance > _OPAQUE_TOLERANCE).any())

    @property
    def has_glass(self) -> bool:
        """True when some slot lets part of what is behind it through: alpha neither 0 nor 1."""
        return self.panes > 0

    @cached_property
    def panes(self) -> int:
        """Slots that let part of what is behind them through: the most in any column."""
        alpha = self.color[..., 3]
        glass = (alpha > 0.0) & (alpha < 1.0 - _OPAQUE_TOLERANCE)
        return int(glass.sum(axis=0, dtype=np.uint8).max())

    @cached_property
    def is_glossy(self) -> bool:
        """True when surfaces look different from different points of the lens, and the frame knows how."""
        return self.lighting is not None and bool((self.surface["specular"] > 0.0).any())

    @cached_property
    def lobe_turn_per_m(self) -> float:
        """How far highlights turn for a step of 1 m sideways, over their own width: the most of all glossy slots.

        A lobe of GGX's width alpha stands half-way between light and eye, so it turns by half the angle that the eye
        does. 0 where nothing is glossy.
        """
        if not self.is_glossy:
            return 0.0
        with np.errstate(divide="ignore"):
            inverse_width = np.sqrt((self.surface["shininess"] + 2.0) / 2.0)
        turn = np.where((self.surface["specular"] > 0.0).any(axis=-1), inverse_width / self.depth, 0.0)
        return float(turn.max()) / 2.0

    def is_glossy_through(self, lens: Lens) -> bool:
        """Whether surfaces look different enough from the points of this lens that it shows."""
        return self.lobe_turn_per_m * lens.aperture_radius_m > _LEAST_TURN

    @cached_property
    def inputs(self) -> dict[str, NDArray[np.float32]]:
        """What a method may read beside colour and depth, by name: surface buffers, and the packed lighting."""
        arrays = dict(self.surface)
        if self.lighting is not None:
            arrays["lighting"] = self.lighting.packed(self.camera, self.guard_px)
            if self.lighting.environment is not None:
                arrays["environment"] = self.lighting.environment.packed
        return arrays

    def pinhole_image(self) -> NDArray[np.float32]:
        """All layers composited without any blur: what a lens of radius 0 sees. (H, W, 4), guard band cropped."""
        guard = self.guard_px
        inner = slice(guard, -guard or None)
        color = self.color[:, inner, inner]
        image: NDArray[np.float32] = color[-1].copy()
        for layer in color[-2::-1]:
            image = layer + (1.0 - layer[..., 3:]) * image
        return image

    def depth_at(self, x: float, y: float) -> float:
        """Depth in metres of the nearest surface at image pixel ``(x, y)``, to focus on; ``inf`` for sky or void."""
        camera = self.camera
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            raise FrameError(
                f"Pixel ({x}, {y}) is outside the image of {camera.width}x{camera.height} (x right, y down, from 0)."
            )
        return float(self.depth[0, int(y) + self.guard_px, int(x) + self.guard_px])

    def save(self, path: str | Path) -> None:
        """Write an uncompressed ``.npz``; the file appears whole or not at all.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        header: dict[str, Any] = {
            "version": _FORMAT_VERSION,
            "camera": self.camera.to_dict(),
            "guard_px": self.guard_px,
        }
        arrays: dict[str, Any] = {"color": self.color, "depth": self.depth, **self.surface}
        if self.lighting is not None:
            header["lighting"] = self.lighting.to_dict()
            if self.lighting.environment is not None:
                arrays["environment"] = self.lighting.environment.image
        if Path(path).suffix != ".npz":
            raise OutputError(f"A frame is saved as .npz; {path} ends otherwise.")
        with atomic_write(path) as stream:
            np.savez(stream, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> LayeredFrame:
        """Read what :meth:`save` wrote. Never unpickles.

        Raises
        ------
        FrameError
            If the file cannot be read or does not hold a frame.
        """
        try:
            if not os.path.isfile(path):
                raise FrameError(f"Cannot read frame {path}: no such file.")
            arrays: dict[str, Any] = read_arrays(path, ("header", "color", "depth", "environment", *_SURFACE_CHANNELS))
            header = parse_json(bytes(arrays.pop("header")))
            if header["version"] != _FORMAT_VERSION:
                raise FrameError(
                    f"Frame {path} has format version {header['version']}; this cldof reads {_FORMAT_VERSION}."
                )
            camera, guard_px = Camera.from_dict(header["camera"]), header["guard_px"]
            color, depth = arrays.pop("color"), arrays.pop("depth")
            environment = Environment(arrays.pop("environment")) if "environment" in arrays else None
            if "lighting" in header:
                arrays["lighting"] = Lighting.from_dict(header["lighting"], environment)
        except FrameError:
            raise
        except Exception as error:  # decoders of damaged files raise whatever comes
            raise FrameError(f"{path} is not a frame saved by cldof ({type(error).__name__}: {error}).") from error
        return cls(color, depth, camera, guard_px=guard_px, **arrays)

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height}"
        return f"LayeredFrame({self.layer_count} layers, {size}, guard {self.guard_px} px)"


def _as_array(value: ArrayLike, name: str) -> NDArray[np.float32]:
    array = np.asarray(value)
    if array.dtype.kind not in "f":
        raise FrameError(
            f"{name} has dtype {array.dtype}; give floats (colour in linear light, so decode 8-bit sRGB images first)."
        )
    return np.ascontiguousarray(array, dtype=np.float32)


def _as_layers(value: ArrayLike, name: str, channels: int | None, size: tuple[int, int]) -> NDArray[np.float32]:
    array = _as_array(value, name)
    tail = (*size, channels) if channels else size
    if array.shape == tail:
        array = array[np.newaxis]
    if array.ndim != len(tail) + 1 or array.shape[1:] != tail or array.shape[0] == 0:
        wanted = "(M, " + ", ".join(str(n) for n in tail) + ")"
        raise FrameError(
            f"{name} has shape {array.shape}; the camera and guard band ask for {wanted} or one layer of it."
        )
    return array.view()


def _refuse(bad: NDArray[np.bool_], name: str, what: str, first: int = 0) -> None:
    count = int(np.count_nonzero(bad))
    if count:
        layer, y, x = np.unravel_index(int(np.argmax(bad)), bad.shape)[:3]
        raise FrameError(f"{name} has {count} {what}; the first is in layer {layer + first} at pixel x={x}, y={y}.")
