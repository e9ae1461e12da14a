"""Trees of lists, dictionaries, numbers, strings and arrays in one file, exactly: npz with JSON inside, no pickle.

Every array is an entry of the npz, once, however often it occurs; JSON, itself an entry, holds the rest and names the
arrays. Python writes floats so that they read back bit for bit; JSON has no infinity, which is written by its name.
"""

import json
import os
import zipfile
from contextlib import suppress
from math import isfinite
from pathlib import Path
from threading import get_ident
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError

Tree: TypeAlias = bool | int | float | str | NDArray[Any] | list["Tree"] | dict[str, "Tree"] | None

_JSON = "json"
_ARRAY = "$array"  # the key of a reference to an array; no key of a tree
_FLOAT = "$float"  # the key of a float that JSON does not have


def write_archive(path: str | Path, tree: Tree) -> None:
    """Write a tree to a file that either is there as a whole or not at all.

    Raises
    ------
    SkyfixError
        When the file cannot be written.
    """
    arrays: dict[str, NDArray[Any]] = {}
    text = json.dumps(_packed(tree, arrays, {}), allow_nan=False)
    arrays[_JSON] = np.frombuffer(text.encode(), dtype=np.uint8)
    path = Path(path)
    draft = path.parent / f".skyfix-{os.getpid()}-{get_ident()}"  # of a length that is allowed wherever the path's is
    try:
        with zipfile.ZipFile(draft, "w") as archive:
            for name, array in arrays.items():
                undated = zipfile.ZipInfo(f"{name}.npy")  # the same tree, the same bytes
                with archive.open(undated, "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, array, allow_pickle=False)
        draft.replace(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SkyfixError(f"{path}: expected a file that can be written, got {reason}") from error
    finally:
        with suppress(OSError, ValueError):
            draft.unlink(missing_ok=True)


def read_archive(path: str | Path) -> Any:
    """Read a tree.

    Raises
    ------
    SkyfixError
        When the file is not there or was not written by `write_archive`.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return _unpacked(json.loads(arrays[_JSON].tobytes().decode()), arrays, {})
    except OSError as error:
        raise SkyfixError(f"{path}: expected a saved file, got {error.strerror or error}") from error
    except Exception as error:  # of damaged bytes the readers of zip, npy and JSON make errors of any type
        raise SkyfixError(f"{path}: expected a saved file, got something else or a damaged one") from error


def plain(value: Any) -> Any:
    """A number, string or None of Python's own, exactly, in place of one of numpy's.

    Raises
    ------
    SkyfixError
        When it is of another type.
    """
    python = value.item() if isinstance(value, np.generic) else value
    if python is not None and not isinstance(python, bool | int | float | str):
        raise SkyfixError(f"archive: expected numbers, strings, lists and arrays, got {type(value).__name__}")
    return python


def _packed(tree: Tree, arrays: dict[str, NDArray[Any]], names: dict[Any, str]) -> Any:
    """What JSON can hold; `names` knows the arrays so far by where they lie in memory."""
    if isinstance(tree, np.ndarray):
        if tree.dtype.hasobject:
            raise SkyfixError(f"archive: expected arrays of numbers, got {tree.dtype}")
        place = (tree.__array_interface__["data"][0], tree.shape, tree.strides, tree.dtype.str)
        name = names.setdefault(place, f"array{len(arrays)}")
        arrays[name] = tree
        return {_ARRAY: name}
    if isinstance(tree, dict):
        for key in (_ARRAY, _FLOAT):
            if key in tree:
                raise SkyfixError(f"archive: expected keys other than {key}, got it")
        return {key: _packed(value, arrays, names) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [_packed(value, arrays, names) for value in tree]
    value = plain(tree)
    if isinstance(value, float) and not isfinite(value):
        return {_FLOAT: repr(value)}
    return value


def _unpacked(packed: Any, arrays: Any, known: dict[str, NDArray[Any]]) -> Any:
    if isinstance(packed, dict):
        if packed.keys() == {_ARRAY}:
            name = packed[_ARRAY]
            if name not in known:
                known[name] = arrays[name]
            return known[name]
        if packed.keys() == {_FLOAT}:
            return float(packed[_FLOAT])
        return {key: _unpacked(value, arrays, known) for key, value in packed.items()}
    if isinstance(packed, list):
        return [_unpacked(value, arrays, known) for value in packed]
    return packed
