"""Takes secrets out of text that leaves the machine."""

import base64
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

HIDDEN: Final = "[left out]"
_SHORTEST: Final = 4  # a secret of three letters would black out half of the text
_NAMED: Final = (
    r"[\w.-]*(?:pass(?:word|wd|phrase)|secret|token|credential|private|api_?key|signing_?key|key_?file|\bkey\b)[\w.-]*"
)
_SENSITIVE: Final = re.compile(_NAMED, re.IGNORECASE)

_PATTERNS: Final = (
    # PEM blocks, whole or cut off at their end
    (re.compile(r"-----BEGIN [A-Z0-9 ]*(?:PRIVATE|CERTIFICATE)[\s\S]*?(?:-----END [A-Z0-9 ]+-----|\Z)"), HIDDEN),
    # a TOML, JSON or shell assignment whose name says that its value is secret
    (
        re.compile(rf"""((?<![\w.-])["']?(?:{_NAMED})["']?\s*[=:]\s*)({'"' * 3}[\s\S]*?{'"' * 3}|'''[\s\S]*?'''"""
                   r"""|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|\[[^\]]*\]|[^\s,;}\]]+)""", re.IGNORECASE),
        rf'\1"{HIDDEN}"',
    ),
    # user and password inside of a URL
    (re.compile(r"(\b[a-z][a-z0-9+.-]*://)[^\s/@]+@", re.IGNORECASE), rf"\1{HIDDEN}@"),
    (re.compile(r"\b((?:bearer|basic)\s+)[A-Za-z0-9+/_.=-]{8,}", re.IGNORECASE), rf"\1{HIDDEN}"),
    # 32 bytes or more in hexadecimal: a signing key, whoever printed it
    (re.compile(r"\b[0-9a-fA-F]{64,}\b"), HIDDEN),
)  # fmt: skip


def redact(text: str, known: Iterable[str] = ()) -> str:
    """The text without secrets.

    Args:
        text: of a configuration, a log, or anything else.
        known: secrets by themselves, wherever they turn up.
    """
    for secret in sorted(set(known), key=len, reverse=True):
        if len(secret) >= _SHORTEST:
            text = text.replace(secret, HIDDEN)
    for pattern, by in _PATTERNS:
        text = pattern.sub(by, text)
    return text


def secrets_in(files: Iterable[Path]) -> set[str]:
    """What files of keys and passwords hold, in each form that a log could show it."""
    found: set[str] = set()
    for file in files:
        try:
            data = file.read_bytes()
        except OSError:
            continue
        found |= {data.hex(), data.hex().upper(), base64.b64encode(data).decode()}
        stripped = data.strip()
        found |= {stripped.hex(), base64.b64encode(stripped).decode()}
        text = stripped.decode(errors="ignore")
        found |= {text, *text.splitlines()}
    return {secret for secret in found if len(secret) >= _SHORTEST}


def secret_files(table: Any) -> set[Path]:
    """Files that values under a telling name point at, in a configuration as nested tables."""
    found: set[Path] = set()
    if isinstance(table, dict):
        for name, value in table.items():
            if isinstance(value, str) and value and _SENSITIVE.search(str(name)):
                found.add(Path(value))
            else:
                found |= secret_files(value)
    elif isinstance(table, list):
        for value in table:
            found |= secret_files(value)
    return found


def literal_secrets(table: Any) -> set[str]:
    """Values under a telling name themselves: they may turn up elsewhere too."""
    return {str(path) for path in secret_files(table)}
