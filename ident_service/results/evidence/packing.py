"""Pack long arrays as short text for numpy and JavaScript: little-endian 16-bit integers in base64.

A packed array is `{"shape": [...], "low": a, "step": b, "data": "..."}` with value = a + b * (integer + 32768), so
that it is off by at most half a step, which is the range of the array divided by 131070. Masks are
`{"bits": n, "data": "..."}`, the first bit of a byte being its lowest.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Any

import numpy as np

from ident_service.errors import ParameterError
from ident_service.results.drawing import LARGEST
from ident_service.results.evidence.evidence import Array, Mask

_LEVELS = 65535
_MOST = 1 << 22  # values of one array
Packed = dict[str, Any]


def packed(values: Array) -> Packed:
    """Pack an array of finite values, of any shape."""
    low, high = float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))
    low, high = (low, high) if values.size else (0.0, 0.0)
    step = (high - low) / _LEVELS
    levels = np.round((values - low) / step) if step > 0.0 else np.zeros(values.shape)
    data = (np.clip(levels, 0, _LEVELS) - 32768).astype("<i2").tobytes()
    return {"shape": list(values.shape), "low": low, "step": step, "data": base64.b64encode(data).decode("ascii")}


def unpacked(content: Mapping[str, Any], shape: tuple[int | None, ...]) -> Array:
    """Unpack an array that `packed` made, to its resolution.

    Args:
        content: of a file.
        shape: what it must have; None where any length will do.

    Raises:
        ParameterError: not a packed array of this shape.
    """
    data, given = _bytes(content), tuple(content["shape"])
    if len(given) != len(shape) or any(want not in (None, have) for want, have in zip(shape, given, strict=True)):
        raise ParameterError(f"an array of shape {list(given)} where {[n or 'any' for n in shape]} is needed")
    if int(np.prod(given)) > _MOST or len(data) != 2 * int(np.prod(given)):
        raise ParameterError(f"an array of shape {list(given)} in {len(data)} bytes")
    if not abs(content["low"]) + _LEVELS * content["step"] < LARGEST:
        raise ParameterError(f"an array of numbers up to {abs(content['low']) + _LEVELS * content['step']:.3g}")
    levels = np.frombuffer(data, "<i2").astype(float) + 32768.0
    return np.asarray((content["low"] + content["step"] * levels).reshape(given))


def packed_mask(mask: Mask) -> Packed:
    """Pack a mask of shape (n,)."""
    data = np.packbits(mask, bitorder="little").tobytes()
    return {"bits": len(mask), "data": base64.b64encode(data).decode("ascii")}


def unpacked_mask(content: Mapping[str, Any], bits: int) -> Mask:
    """Unpack a mask that `packed_mask` made.

    Raises:
        ParameterError: not a mask of this length.
    """
    data = _bytes(content)
    if content["bits"] != bits or len(data) != -(-bits // 8):
        raise ParameterError(f"a mask of {content['bits']} bits in {len(data)} bytes where {bits} are needed")
    return np.unpackbits(np.frombuffer(data, np.uint8), count=bits, bitorder="little").astype(bool)


def _bytes(content: Mapping[str, Any]) -> bytes:
    try:
        return base64.b64decode(content["data"], validate=True)
    except (binascii.Error, ValueError) as error:
        raise ParameterError(f"an array that is not base64: {error}") from None
