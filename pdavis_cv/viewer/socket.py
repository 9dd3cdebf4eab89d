"""WebSocket for the page's requests for images: the necessary part of RFC 6455.

An HTTP request per image would cost a browser several times as much as drawing it.
"""
from __future__ import annotations

import base64
import binascii
import hashlib
import struct
from collections.abc import Mapping
from typing import Protocol

_GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"     # RFC 6455, 1.3
_TEXT, _CLOSE, _PING, _PONG = 1, 8, 9, 10
_BINARY = 2
_FINAL, _MASKED, _RESERVED = 0x80, 0x80, 0x70
_SHORT, _MIDDLE, _LONG = 125, 126, 127
_POLICY = 1008      # RFC 6455, 7.4.1: a message that is not taken
MOST_REQUEST = 4_096
"""Largest message that requests an image, bytes."""


class Readable(Protocol):
    """Gives as many bytes as asked for, fewer at the end."""

    def read(self, count: int, /) -> bytes:
        """Return them."""


def accepted_key(headers: Mapping[str, str]) -> str:
    """Return the handshake's answer to the WebSocket key in a request's headers.

    ValueError if the request is not for a WebSocket of version 13.
    """
    headers = {name.lower(): value for name, value in headers.items()}
    if headers.get("upgrade", "").lower() != "websocket":
        raise ValueError("Upgrade must be websocket")
    if headers.get("sec-websocket-version") != "13":
        raise ValueError("Sec-WebSocket-Version must be 13")
    key = headers.get("sec-websocket-key", "")
    try:
        good = len(base64.b64decode(key, validate=True)) == 16
    except (binascii.Error, ValueError):
        good = False
    if not good:
        raise ValueError("Sec-WebSocket-Key must be 16 bytes in base64")
    digest = hashlib.sha1(key.encode() + _GUID, usedforsecurity=False).digest()
    return base64.b64encode(digest).decode()


def received(file: Readable) -> bytes | None:
    """Return the next text that a client sends, None where it hangs up.

    ValueError if it is no WebSocket's, longer than `MOST_REQUEST` or in parts.
    """
    while True:
        head = file.read(2)
        if len(head) < 2:
            return None
        kind, length = head[0] & 0x0F, head[1] & ~_MASKED
        if not head[0] & _FINAL or head[0] & _RESERVED or not head[1] & _MASKED:
            raise ValueError("a message must be whole, plain and masked")
        if length >= _MIDDLE:       # the length follows, in two bytes or in eight
            length = int.from_bytes(_exactly(file, 2 if length == _MIDDLE else 8))
        if length > MOST_REQUEST:
            raise ValueError(f"a message is at most {MOST_REQUEST} bytes")
        mask = _exactly(file, 4)
        data = bytes(byte ^ mask[i % 4]
                     for i, byte in enumerate(_exactly(file, length)))
        if kind == _TEXT:
            return data
        if kind == _CLOSE:
            return None
        if kind not in (_PING, _PONG):
            raise ValueError(f"a message must be text, got kind {kind}")


def _exactly(file: Readable, count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise ValueError("a message ended early")
    return data


def binary(length: int) -> bytes:
    """Return what stands before a binary message of so many bytes."""
    return _head(_BINARY, length)


def closing(reason: str) -> bytes:
    """Return the message that ends a connection and says why."""
    # As much as is whole characters: a browser refuses others.
    text = reason.encode()[:_SHORT - 2].decode(errors="ignore").encode()
    text = struct.pack(">H", _POLICY) + text
    return _head(_CLOSE, len(text)) + text


def _head(kind: int, length: int) -> bytes:
    first = bytes((_FINAL | kind,))
    if length <= _SHORT:
        return first + bytes((length,))
    if length < 1 << 16:
        return first + struct.pack(">BH", _MIDDLE, length)
    return first + struct.pack(">BQ", _LONG, length)
