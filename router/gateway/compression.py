"""zstd frames of payloads; the only module that knows the library.

Both directions let go of the interpreter lock while they work.
"""

from __future__ import annotations

import threading

from backports import zstd

from router.gateway.packets import PacketError, TooLargeError

_SMALL = 1 << 16
"""Up to so many bytes one compressor is used again and again: making one takes three times as long as its work.
Of more, it would keep up to hundreds of megabytes."""

_LEAST_WINDOW_LOG = 23
"""8 MiB, which RFC 8878 (3.1.1.1.2) wants every decoder to support."""

_MAGIC = b"\x28\xb5\x2f\xfd"
"""Of a frame that has content; there are others that are to be skipped."""


class _Compressors(threading.local):
    """By level, one for each thread: a second thread would have to wait for the first."""

    def __init__(self) -> None:
        self.by_level: dict[int, zstd.ZstdCompressor] = {}


_compressors = _Compressors()


def compress(data: bytes, level: int) -> bytes:
    """One zstd frame with the content's size in its header, which some clients need; level 1 to 22."""
    if len(data) > _SMALL:
        return zstd.compress(data, level)
    compressor = _compressors.by_level.get(level)
    if compressor is None:
        compressor = _compressors.by_level[level] = zstd.ZstdCompressor(level)
    frame: bytes = compressor.compress(data, zstd.ZstdCompressor.FLUSH_FRAME)
    return frame


def told_size(data: bytes) -> int | None:
    """Bytes that a frame holds by its header, which `decompress` goes by; None if not told, 0 for what is no frame."""
    try:
        size: int | None = zstd.get_frame_info(data).decompressed_size
    except zstd.ZstdError:
        return 0
    return size


def decompress(data: bytes, most: int) -> bytes:
    """The content of one zstd frame, at most `most` bytes. The frame's window takes no more memory than that, or 8 MiB.

    Raises TooLargeError for more, PacketError for anything else: damage, a second frame, what needs a dictionary.
    """
    if not data.startswith(_MAGIC):
        raise PacketError("the payload is no zstd frame")
    try:
        told = told_size(data)
        if told is not None and told > most:
            raise TooLargeError(f"the payload is {told} bytes uncompressed, more than {most}")
        limit = told or most
        window = max(_LEAST_WINDOW_LOG, (most - 1).bit_length())
        decompressor = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: window})
        content: bytes = decompressor.decompress(data, limit + 1)
    except zstd.ZstdError as error:
        raise PacketError(f"the payload cannot be decompressed: {error}") from error
    if len(content) > limit:
        raise TooLargeError(f"the payload is more than {limit} bytes uncompressed")
    if not decompressor.eof:
        raise PacketError("the payload ends before its zstd frame does")
    if decompressor.unused_data:
        raise PacketError("bytes follow the payload's zstd frame")
    return content
