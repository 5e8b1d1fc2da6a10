"""Images out of the library: PNG for eyes, EXR and npy for further work, each with the lens that made it.

Inside cldof an image is (H, W, 4) float32, linear light, premultiplied alpha, unbounded above. sRGB, straight alpha and
8 bits exist here only, at the file's border:

==== ===================================== ==============================================================
.png 8-bit sRGB, straight alpha, clipped   metadata as JSON in the text chunk ``cldof``; RGB when opaque
.exr linear float32 (or half)              metadata as JSON in the string attribute ``cldof``; ZIP, scan lines
.npy linear float32 (H, W, 4)              metadata in ``<name>.npy.json`` beside it
==== ===================================== ==============================================================
"""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import CldofError, InputError, OutputError
from .files import atomic_write, parse_json, read_json

__all__ = [
    "check_picture",
    "check_writable",
    "linear_from_srgb",
    "opened_picture",
    "read_linear",
    "read_metadata",
    "save_image",
    "srgb8_from_linear",
    "srgb_from_linear",
    "supported_extensions",
]

_METADATA_KEY = "cldof"
# What pictures are read from, and how large they may be: Pillow knows formats that run other programs, and opens
# pictures whose header promises any size.
_READ_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TIFF", "TGA", "PPM")
_MOST_PIXELS = 1 << 27
# Alpha below half a step of 8 bits is written as 0; only above it is colour divided by alpha.
_ALPHA_THRESHOLD = 0.5 / 255.0


def srgb_from_linear(linear: ArrayLike) -> NDArray[np.float32]:
    """Encode linear light with the piecewise sRGB curve (IEC 61966-2-1); values are clipped to [0, 1]."""
    value = np.clip(np.asarray(linear, dtype=np.float32), 0.0, 1.0)
    curve = np.float32(1.055) * np.power(value, np.float32(1.0 / 2.4)) - np.float32(0.055)
    return np.where(value <= np.float32(0.0031308), np.float32(12.92) * value, curve)


def linear_from_srgb(encoded: ArrayLike) -> NDArray[np.float32]:
    """Decode sRGB in [0, 1] to linear light: the inverse of :func:`srgb_from_linear`."""
    value = np.clip(np.asarray(encoded, dtype=np.float32), 0.0, 1.0)
    curve = np.power((value + np.float32(0.055)) / np.float32(1.055), np.float32(2.4))
    return np.where(value <= np.float32(0.04045), value / np.float32(12.92), curve)


def srgb8_from_linear(image: ArrayLike) -> NDArray[np.uint8]:
    """Premultiplied linear (H, W, 4) to straight-alpha 8-bit sRGB: (H, W, 4), or (H, W, 3) when it is opaque."""
    array = _as_image(image)
    alpha = np.clip(array[..., 3:], 0.0, 1.0)
    visible = alpha >= _ALPHA_THRESHOLD
    straight = np.where(visible, array[..., :3] / np.where(visible, alpha, 1.0), 0.0)
    color = _to_bytes(srgb_from_linear(straight))
    coverage = _to_bytes(alpha)
    return color if coverage.min() == 255 else np.concatenate([color, coverage], axis=-1)


def check_picture(source: Any, what: str, error_class: type[CldofError] = InputError) -> tuple[int, int]:
    """Look at the header of a picture that somebody else made, before anything is decoded.

    Parameters
    ----------
    source : path, binary stream or PIL.Image.Image
    what : str
        What it is, for messages.
    error_class : type
        What to raise.

    Returns
    -------
    (int, int)
        Width and height.
    """
    from PIL import Image

    if isinstance(source, Image.Image):
        size, kind = source.size, source.format
    else:
        with opened_picture(source, what, error_class) as picture:
            size, kind = picture.size, picture.format
    if kind not in (None, "MPO", *_READ_FORMATS):  # MPO: a JPEG with more than one picture
        raise error_class(f"Cannot read {what}: it is a {kind} file; {', '.join(_READ_FORMATS)} are read.")
    if size[0] * size[1] > _MOST_PIXELS:
        raise error_class(f"Cannot read {what}: it has {size[0]}x{size[1]} pixels; at most {_MOST_PIXELS} are read.")
    width, height = size
    return int(width), int(height)


@contextmanager
def opened_picture(source: Any, what: str, error_class: type[CldofError] = InputError) -> Iterator[Any]:
    """A picture of a known format; whatever goes wrong inside the block is `error_class`. Decodes nothing by itself."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # there is a limit of our own
            with Image.open(source, formats=_READ_FORMATS) as picture:
                yield picture
    except CldofError:
        raise
    except Exception as error:  # decoders of damaged files raise whatever comes
        reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        raise error_class(f"Cannot read {what}: {reason}.") from error


def supported_extensions() -> tuple[str, ...]:
    """File name endings that :func:`save_image` writes."""
    return tuple(_WRITERS)


def check_writable(path: str | Path, extensions: tuple[str, ...] | None = None) -> Path:
    """Find out before the work is done whether its result can be saved at ``path``; leaves nothing behind.

    Parameters
    ----------
    path : str or Path
    extensions : tuple of str, optional
        Endings to accept; those of :func:`save_image` by default, ``()`` for any.

    Raises
    ------
    OutputError
        For an unknown ending, a folder that is missing or closed to us, or a path that is a folder.
    """
    target = Path(path)
    known = supported_extensions() if extensions is None else extensions
    if known and target.suffix.lower() not in known:
        ending = f"ends in {target.suffix!r}" if target.suffix else "has no ending"
        raise OutputError(f"Cannot write {target}: its name {ending}; supported are {', '.join(known)}.")
    if target.is_dir():
        raise OutputError(f"Cannot write {target}: it is a folder; name a file.")
    if not target.parent.is_dir():
        raise OutputError(f"Cannot write {target}: the folder {target.parent} does not exist; create it first.")
    try:
        with tempfile.NamedTemporaryFile(prefix=f".{target.name}.", dir=target.parent):
            pass
    except OSError as error:
        raise OutputError(f"Cannot write {target}: {error.strerror or error}.") from error
    return target


def save_image(
    path: str | Path, image: ArrayLike, metadata: Mapping[str, Any] | None = None, *, half: bool = False
) -> None:
    """Write an image in the format that its name ends with; the file appears whole or not at all.

    Parameters
    ----------
    path : str or Path
        Ends in ``.png``, ``.exr`` or ``.npy``.
    image : array_like, (H, W, 4)
        Linear light, premultiplied alpha.
    metadata : mapping, optional
        What made the image (lens, camera, method ...): anything that JSON can hold.
    half : bool
        EXR only: 16-bit floats, a third of the size, for images within 6e-8 .. 65504.

    Raises
    ------
    InputError
        If the image has another shape or the metadata does not fit into JSON.
    OutputError
        If the file cannot be written.
    """
    target = check_writable(path)
    array = _as_image(image)
    try:
        text = json.dumps(dict(metadata or {}), allow_nan=False, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise InputError(f"Image metadata does not fit into JSON: {error}.") from error
    if half and np.nanmax(np.abs(array), initial=0.0) > np.finfo(np.float16).max:
        raise InputError(f"Image reaches {array.max():g}, beyond half floats (65504); write full floats.")
    writer = _WRITERS[target.suffix.lower()]
    writer(target, array.astype(np.float16) if half else array, text)


def read_linear(path: str | Path) -> NDArray[np.float32]:
    """Read a picture as linear light, (H, W, 3) float32, alpha left out.

    ``.exr`` and ``.npy`` hold linear light; everything else (PNG, JPEG, ...) is taken for 8-bit sRGB.

    Raises
    ------
    InputError
        If the file cannot be read, or holds something else.
    """
    source = Path(path)
    suffix = source.suffix.lower()
    try:
        if suffix == ".npy":
            array = np.load(source, mmap_mode="r", allow_pickle=False)
        elif suffix == ".exr":
            array = _read_exr(source)
        else:
            check_picture(source, str(source))
            with opened_picture(source, str(source)) as picture:
                return linear_from_srgb(np.asarray(picture.convert("RGB")) / np.float32(255.0))
        if array.dtype.kind != "f" or array.ndim != 3 or array.shape[2] not in (3, 4):
            raise InputError(
                f"{source} holds {array.dtype} of shape {array.shape}; it must be floats, (H, W, 3) or (H, W, 4)."
            )
        if array.shape[0] * array.shape[1] > _MOST_PIXELS:
            raise InputError(f"{source} has {array.shape[1]}x{array.shape[0]} pixels; at most {_MOST_PIXELS} are read.")
        return np.array(array[..., :3], np.float32)
    except InputError:
        raise
    except Exception as error:  # decoders of damaged files raise whatever comes
        raise InputError(f"Cannot read {source}: {getattr(error, 'strerror', None) or error}.") from error


def _read_exr(source: Path) -> NDArray[Any]:
    import OpenEXR

    # The header first: a damaged one may promise any number of pixels.
    with OpenEXR.File(str(source), header_only=True) as exr:
        low, high = exr.header()["dataWindow"]
        width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    if width * height > _MOST_PIXELS:
        raise InputError(f"{source} has {width}x{height} pixels; at most {_MOST_PIXELS} are read.")
    with OpenEXR.File(str(source)) as exr:
        channels = exr.channels()
        name = next((name for name in ("RGBA", "RGB") if name in channels), None)
        if name is None:
            raise InputError(f"{source} has channels {', '.join(channels)}; it must have R, G and B.")
        return np.array(channels[name].pixels)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The metadata that :func:`save_image` wrote with the image at ``path``; empty when there is none.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    source = Path(path)
    suffix = source.suffix.lower()
    try:
        if suffix == ".png":
            with opened_picture(source, f"the metadata of {source}") as picture:
                data = parse_json(picture.info.get(_METADATA_KEY, "{}"))
        elif suffix == ".exr":
            import OpenEXR

            # Of the header alone: a damaged one may promise any number of pixels.
            with OpenEXR.File(str(source), header_only=True) as exr:
                data = parse_json(exr.header().get(_METADATA_KEY, "{}"))
        elif suffix == ".npy":
            data = read_json(_sidecar(source), f"the metadata of {source}")
        else:
            raise InputError(f"{source} is not an image of ours; supported are {', '.join(supported_extensions())}.")
        if not isinstance(data, dict):
            raise InputError(
                f"Cannot read the metadata of {source}: it is a {type(data).__name__} and not a JSON object."
            )
    except InputError:
        raise
    except Exception as error:  # decoders of damaged files raise whatever comes
        raise InputError(f"Cannot read the metadata of {source}: {error}.") from error
    return data


def _write_png(target: Path, array: NDArray[np.float32], text: str) -> None:
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    chunks = PngInfo()
    chunks.add_itxt(_METADATA_KEY, text)
    picture = Image.fromarray(srgb8_from_linear(array))
    with atomic_write(target) as stream:
        picture.save(stream, format="PNG", pnginfo=chunks)


def _write_exr(target: Path, array: NDArray[Any], text: str) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, _METADATA_KEY: text}
    # OpenEXR writes to a path and not to a stream, so the file is made in a private folder first.
    with tempfile.TemporaryDirectory(prefix="cldof-") as folder:
        name = Path(folder) / "image.exr"
        try:
            with OpenEXR.File(header, {"RGBA": np.ascontiguousarray(array)}) as exr:
                exr.write(str(name))
        except RuntimeError as error:
            raise OutputError(f"Cannot write {target}: {error}.") from error
        with atomic_write(target) as stream:
            stream.write(name.read_bytes())


def _write_npy(target: Path, array: NDArray[np.float32], text: str) -> None:
    # Both are whole before either appears.
    with atomic_write(_sidecar(target)) as sidecar, atomic_write(target) as stream:
        np.save(stream, array.astype(np.float32, copy=False), allow_pickle=False)
        sidecar.write(text.encode() + b"\n")


_WRITERS: dict[str, Callable[[Path, NDArray[Any], str], None]] = {
    ".png": _write_png,
    ".exr": _write_exr,
    ".npy": _write_npy,
}


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _as_image(image: ArrayLike) -> NDArray[np.float32]:
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[2] != 4 or array.size == 0 or array.dtype.kind != "f":
        raise InputError(f"An image is (H, W, 4) floats, linear and premultiplied; got {array.dtype} {array.shape}.")
    return np.ascontiguousarray(array, dtype=np.float32)


def _to_bytes(value: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray(value * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)
