"""What a refusal looks like: a stable code, and one sentence that a person can read."""

from __future__ import annotations

import re

CODE = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*(\.[a-z0-9]+(-[a-z0-9]+)*)+")
MAX_CHARS = 20_000


def coded_sentence(error: Exception) -> None:
    """Check an error's code and text."""
    code = getattr(error, "code", "")
    assert isinstance(code, str) and CODE.fullmatch(code), f"code {code!r}"
    text = str(error)
    assert text.strip(), f"{code} has no sentence"
    assert len(text) < MAX_CHARS, f"{code}: {len(text)} characters"
    assert "Traceback" not in text and "object at 0x" not in text, text
