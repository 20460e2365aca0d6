"""The messages between cloud and client, as bytes. No sockets, no order of sending, no codec.

Every message is an envelope of 12 bytes and the body: magic, version, kind and whether the body is
a zstd frame (it is where that makes it smaller), and a 64-bit checksum of everything else. What
damages a message is refused before anything in it is looked at.
"""

from __future__ import annotations

import hashlib
import struct

import zstandard

from gaussians.errors import InputError

MAGIC = b"NB"
VERSION = 5
SESSION_START = 1
DELTA_CUT = 2
PROBE = 3
REPORT = 4
_HEAD = struct.Struct("<2sBB")  # magic, version, kind
_CHECKSUM_BYTES = 8
_ENVELOPE_BYTES = _HEAD.size + _CHECKSUM_BYTES
_PACKED = 128  # added to the kind
_ZSTD_LEVEL = 3  # level 19 gains 1 to 2 % on these messages
_BODY_LIMIT = 1 << 34


class RemoteProtocolError(InputError):
    """The other side broke a rule, or the line damaged a message."""


class LocalProtocolError(InputError):
    """This side asked an endpoint for something that the state of the session does not allow."""


def seal(kind: int, body: bytes) -> bytes:
    """A complete message."""
    packed = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(body)
    if len(packed) < len(body):
        kind, body = kind | _PACKED, packed
    head = _HEAD.pack(MAGIC, VERSION, kind)
    return head + _checksum(head, body) + body


def unseal(message: bytes) -> tuple[int, bytes]:
    """Kind and body of a message. Raises RemoteProtocolError when it is not exactly one whole
    message.
    """
    if len(message) < _ENVELOPE_BYTES:
        raise RemoteProtocolError(
            f"message must have at least {_ENVELOPE_BYTES} bytes, not {len(message)}"
        )
    magic, version, kind = _HEAD.unpack_from(message)
    if magic != MAGIC:
        raise RemoteProtocolError(f"message must start with {MAGIC!r}, not {magic!r}")
    if version != VERSION:
        raise RemoteProtocolError(f"message version must be {VERSION}, not {version}")
    head, body = message[: _HEAD.size], message[_ENVELOPE_BYTES:]
    if message[_HEAD.size : _ENVELOPE_BYTES] != _checksum(head, body):
        raise RemoteProtocolError("message checksum must match; the message was damaged")
    return (kind - _PACKED, _unpacked(body)) if kind & _PACKED else (kind, body)


def _unpacked(body: bytes) -> bytes:
    try:
        if zstandard.get_frame_parameters(body).content_size > _BODY_LIMIT:
            raise RemoteProtocolError(f"message body must have at most {_BODY_LIMIT} bytes")
        return zstandard.ZstdDecompressor().decompress(body)
    except zstandard.ZstdError as error:
        raise RemoteProtocolError(f"message must hold a zstd frame: {error}") from error


def _checksum(head: bytes, body: bytes) -> bytes:
    digest = hashlib.blake2b(head, digest_size=_CHECKSUM_BYTES)
    digest.update(body)
    return digest.digest()
