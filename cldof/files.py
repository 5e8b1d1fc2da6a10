"""Writing files so that they appear whole or not at all, and reading those of others without trust."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
from numpy.typing import NDArray

from .errors import CldofError, InputError, OutputError

__all__ = ["atomic_write", "parse_json", "read_arrays", "read_json"]

# Of a JSON file: benchmark results of a hundred scenes are 10 MB.
_MOST_JSON = 1 << 28
# Of a compressed archive: what it may unpack to, in bytes and over its own size. 1 GB of zeros fits into 1 MB.
_MOST_UNPACKED, _MOST_GROWTH = 1 << 30, 20
_CHUNK = 1 << 24


@contextmanager
def atomic_write(path: str | Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside ``path`` and move it there when the block ends well; remove it otherwise.

    Raises
    ------
    OutputError
        If the folder does not exist or cannot be written.
    """
    target = Path(path)
    if target.is_dir():
        raise OutputError(f"Cannot write {target}: it is a folder.")
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    except OSError as error:
        raise OutputError(f"Cannot write {target}: {error.strerror or error}.") from error
    try:
        with os.fdopen(handle, "wb") as stream:
            yield stream
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)  # mkstemp makes private files; a result is an ordinary one
        os.replace(name, target)
    except OSError as error:
        _remove(name)
        raise OutputError(f"Cannot write {target}: {error.strerror or error}.") from error
    except BaseException:
        _remove(name)
        raise


def parse_json(text: str | bytes | memoryview) -> Any:
    """As :func:`json.loads`, but every failure is a ValueError, nesting without end included."""
    try:
        return json.loads(bytes(text) if isinstance(text, memoryview) else text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_json(path: str | Path, what: str, error_class: type[CldofError] = InputError) -> Any:
    """What a JSON file holds.

    Parameters
    ----------
    path : path
    what : str
        What it is, for messages.
    error_class : type
        What is raised for a file that is missing, too large or not JSON.
    """
    try:
        with open(path, "rb") as stream:
            text = stream.read(_MOST_JSON + 1)
    except OSError as error:
        raise error_class(f"Cannot read {what}: {error.strerror or error}.") from error
    if len(text) > _MOST_JSON:
        raise error_class(f"Cannot read {what}: it is larger than {_MOST_JSON} bytes.")
    try:
        return parse_json(text)
    except ValueError as error:
        raise error_class(f"Cannot read {what}: it is not JSON ({error}).") from error


def read_arrays(path: str | Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Arrays of a .npz file by name, without those that it lacks. Never unpickles.

    What an array needs is known from its header before anything is unpacked.

    Raises
    ------
    ValueError
        For an array of objects, one that is not as large as it says, or an archive that unpacks to far more than it
        is itself. What is no archive raises whatever the decoders do.
    """
    arrays, unpacked = {}, 0
    with open(path, "rb") as file, ZipFile(file) as archive:
        own_bytes = os.fstat(file.fileno()).st_size
        members = {info.filename: info for info in archive.infolist()}
        for name in names:
            info = members.get(f"{name}.npy")
            if info is None:
                continue
            unpacked += info.file_size
            if info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
                raise ValueError(f"array {name!r} is packed by a method that is not read ({info.compress_type})")
            if info.compress_type == ZIP_STORED and info.file_size > own_bytes:
                raise ValueError(f"array {name!r} is said to have {info.file_size} bytes in a file of {own_bytes}")
            if unpacked > max(_MOST_UNPACKED, _MOST_GROWTH * own_bytes):
                raise ValueError(f"its arrays unpack to {unpacked} bytes from a file of {own_bytes}")
            with archive.open(info) as stream:
                arrays[name] = _read_array(stream, info.file_size, name)
    return arrays


def _read_array(stream: IO[bytes], nbytes: int, name: str) -> NDArray[Any]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, is_fortran, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"array {name!r} has format version {version}, which is not read")
    if dtype.hasobject:
        raise ValueError(f"array {name!r} holds Python objects, which are never unpickled")
    needed = dtype.itemsize * math.prod(shape)
    if needed != nbytes - stream.tell():
        raise ValueError(f"array {name!r} of shape {shape} needs {needed} bytes and has {nbytes - stream.tell()}")
    array = np.empty(shape, dtype, order="F" if is_fortran else "C")
    view = array.reshape(-1, order="F" if is_fortran else "C").view(np.uint8).data
    filled = 0
    while filled < needed:
        if not (count := stream.readinto(view[filled : filled + _CHUNK])):  # type: ignore[attr-defined]
            raise ValueError(f"array {name!r} ends after {filled} of {needed} bytes")
        filled += count
    stream.read(1)  # the end, where zipfile compares checksums
    return array


def _remove(name: str) -> None:
    with suppress(OSError):
        os.unlink(name)
