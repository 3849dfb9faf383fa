"""The text of a file that another tool wrote."""

from __future__ import annotations

from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE
from typing import Final

HEAD_BYTES: Final = 256


def decoded(content: bytes, fallback: str) -> str:
    """Decode UTF-8 or UTF-16, with or without byte order mark; bytes not in UTF-8 are ``fallback``'s or replaced."""
    if content.startswith(BOM_UTF8):
        return content[len(BOM_UTF8) :].decode("utf-8", "replace")
    if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return content.decode("utf-16", "replace")
    head = content[:HEAD_BYTES]
    for encoding, zeros, letters in (("utf-16-le", head[1::2], head[::2]), ("utf-16-be", head[::2], head[1::2])):
        if zeros.count(0) > len(zeros) // 2 and not letters.count(0):
            return content.decode(encoding, "replace")
    others = {0xDC00 + byte: bytes((byte,)).decode(fallback, "replace") for byte in range(0x80, 0x100)}
    return content.decode("utf-8", "surrogateescape").translate(others)
