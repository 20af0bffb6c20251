"""openpi's wire format: msgpack, in which an array is a map of its bytes, dtype and shape.

Read from Physical-Intelligence/openpi at 15a9616, `msgpack_numpy.py` and `websocket_policy_server.py`.
Only arrays of booleans, integers and floats pass, in both directions: no objects, and no pickle.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np

from lerobot_roborecover.policies.remote.errors import WireError

_KINDS = "biuf"
_DTYPE = re.compile(r"[<>|=]?([biu][1248]|f[248])|bool|u?int(8|16|32|64)|float(16|32|64)")
"""What numpy is asked to read: its own parser of dtypes takes whole structures, and raises what it likes."""
_MAX_DIMENSIONS = 16
_LONGEST = 4096
"""Values of one list or map, whose room is made before they have been read."""
_MOST_VALUES = 65_536
"""Values of all lists and maps of a frame: a byte on the wire may be sixty in memory. An array is one."""
_LONGEST_TEXT = 2**20
"""Characters of a text: one that is not ASCII makes every one of them four bytes."""


def pack(message: Any) -> bytes:
    """Bytes of a message of plain values and arrays.

    Raises:
        WireError: it holds something that the protocol does not carry.
    """
    try:
        return msgpack.packb(message, default=_encode)
    except (TypeError, ValueError, OverflowError) as err:
        raise WireError(f"cannot be sent: {err}") from err


def unpack(data: bytes, what: str = "message") -> Any:
    """The message of some bytes; arrays are read-only.

    Args:
        data: a whole frame.
        what: who sent it, for the error.

    Raises:
        WireError: the bytes are no msgpack, or hold an array that is not allowed or lies about its size, or
            more values than any request has.
    """
    return unpack_bounded(data, what, "openpi's msgpack", _decode)


def unpack_bounded(data: bytes, what: str, form: str, decode: Callable[[dict], Any]) -> Any:
    """The message of some bytes that a stranger may have made.

    Args:
        data: a whole frame.
        what: who sent it, for the error.
        form: what the bytes should be, for the error.
        decode: makes an array of a map that stands for one, and gives back any other.

    Raises:
        WireError: the bytes are no msgpack, hold more values than any message has, or `decode` raised.
    """
    left = _MOST_VALUES

    def count(values: int) -> None:
        nonlocal left
        left -= values
        if left < 0:
            raise ValueError(f"more than {_MOST_VALUES} values in lists and maps; send numbers as arrays")

    def map_read(content: dict) -> Any:
        count(2 * len(content) + 1)
        return decode(content)

    def list_read(content: list) -> list:
        count(len(content) + 1)
        return content

    try:
        return msgpack.unpackb(
            data, object_hook=map_read, list_hook=list_read, max_array_len=_LONGEST, max_map_len=_LONGEST,
            max_str_len=_LONGEST_TEXT, max_ext_len=0,
        )  # fmt: skip
    except Exception as err:  # whatever a stranger's bytes make of it, it is their fault and no reason to end
        reason = str(err) or type(err).__name__
        raise WireError(f"{what}: {len(data)} bytes that are not {form}: {reason}") from err


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in _KINDS:
        raise ValueError(f"arrays of dtype {value.dtype} are not sent; only booleans, integers and floats")
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} is not sent; only plain values and arrays")


def _decode(value: dict) -> Any:
    if b"__ndarray__" in value:
        return checked_array(value.get(b"dtype"), value.get(b"shape"), value.get(b"data"))
    if b"__npgeneric__" in value:
        return checked_dtype(value.get(b"dtype")).type(value.get(b"data"))
    return value


def checked_dtype(name: Any) -> np.dtype:
    """A dtype of booleans, integers or floats.

    Args:
        name: as it came.

    Raises:
        ValueError: it is another one, or none.
    """
    dtype = np.dtype(name) if isinstance(name, str) and _DTYPE.fullmatch(name) else None
    if dtype is None or dtype.kind not in _KINDS:
        raise ValueError(f"array of dtype {name!r:.60}; only booleans, integers and floats are taken")
    return dtype


def checked_array(name: Any, shape: Any, data: Any) -> np.ndarray:
    """A read-only array.

    Args:
        name: of its dtype, as it came.
        shape: its shape, as it came.
        data: its bytes, as they came.

    Raises:
        ValueError: these are not an array.
    """
    dtype = checked_dtype(name)
    whole = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if not whole or len(shape) > _MAX_DIMENSIONS or not isinstance(data, bytes):
        raise ValueError(f"array of shape {shape!r:.100} with {type(data).__name__} data")
    if math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"array of shape {shape} and dtype {dtype} with {len(data)} bytes of data")
    return np.frombuffer(data, dtype).reshape(shape)
