"""Emulate the SDO server of a drive: expedited and segmented transfers, one at a time (CiA 301, 7.2.4).

Block transfers are refused with an abort code, as a server without them does.
"""

from __future__ import annotations

import struct

from sim_backend.canopen_device.objects import COMMAND, TOGGLE, TOO_LONG, TOO_SHORT, Objects, SdoAbort

_LARGEST = 4096  # bytes of a segmented download; no object is larger


class SdoServer:
    """Serve one client."""

    def __init__(self, objects: Objects) -> None:
        """Serve the given objects."""
        self._objects = objects
        self.reset()

    def reset(self) -> None:
        """Discard a transfer that has begun."""
        self._multiplexer = (0, 0)
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._announced: int | None = None
        self._toggle = 0

    def answer(self, request: bytes) -> bytes | None:
        """Return the response to one request; None where there is none (wrong length, a client's abort)."""
        if len(request) != 8:
            return None
        command = request[0] >> 5
        if command == 4:
            self.reset()
            return None
        try:
            match command:
                case 0:
                    return self._download_segment(request)
                case 1:
                    return self._initiate_download(request)
                case 2:
                    return self._initiate_upload(request)
                case 3:
                    return self._upload_segment(request)
            self._multiplexer = struct.unpack_from("<HB", request, 1)
            raise SdoAbort(COMMAND)
        except SdoAbort as abort:
            index, subindex = self._multiplexer
            self.reset()
            return struct.pack("<BHBI", 0x80, index, subindex, abort.code)

    def _initiate_download(self, request: bytes) -> bytes:
        self.reset()
        first, index, subindex = struct.unpack_from("<BHB", request)
        self._multiplexer = (index, subindex)
        expedited, sized = first & 2, first & 1
        if expedited:
            # Without a size, all four bytes count, of which the object takes as many as it has.
            length = 4 - (first >> 2 & 3) if sized else self._objects.size(index, subindex) or 4
            self._objects.write(index, subindex, request[4 : 4 + length])
        else:
            self._announced = struct.unpack_from("<I", request, 4)[0] if sized else None
            if self._announced is not None and self._announced > _LARGEST:
                raise SdoAbort(TOO_LONG)
            self._objects.size(index, subindex)
            self._download = bytearray()
        return struct.pack("<BHBI", 0x60, index, subindex, 0)

    def _download_segment(self, request: bytes) -> bytes:
        if self._download is None:
            raise SdoAbort(COMMAND)
        toggle = self._toggled(request)
        self._download += request[1 : 8 - (request[0] >> 1 & 7)]
        if len(self._download) > _LARGEST:
            raise SdoAbort(TOO_LONG)
        if request[0] & 1:
            data, self._download = bytes(self._download), None
            if self._announced is not None and len(data) != self._announced:
                raise SdoAbort(TOO_LONG if len(data) > self._announced else TOO_SHORT)
            self._objects.write(*self._multiplexer, data)
        return struct.pack("<B7x", 0x20 | toggle)

    def _initiate_upload(self, request: bytes) -> bytes:
        self.reset()
        index, subindex = struct.unpack_from("<HB", request, 1)
        self._multiplexer = (index, subindex)
        data = self._objects.read(index, subindex)
        if 1 <= len(data) <= 4:
            return struct.pack("<BHB4s", 0x43 | (4 - len(data)) << 2, index, subindex, data)
        self._upload = data
        return struct.pack("<BHBI", 0x41, index, subindex, len(data))

    def _upload_segment(self, request: bytes) -> bytes:
        if self._upload is None:
            raise SdoAbort(COMMAND)
        toggle = self._toggled(request)
        part, rest = self._upload[:7], self._upload[7:]
        self._upload = rest or None
        return struct.pack("<B7s", toggle | (7 - len(part)) << 1 | (not rest), part)

    def _toggled(self, request: bytes) -> int:
        """Return the toggle bit, which must alternate from 0."""
        toggle = request[0] & 0x10
        if toggle != self._toggle:
            raise SdoAbort(TOGGLE)
        self._toggle ^= 0x10
        return toggle
