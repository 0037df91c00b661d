"""Salt: a course's secret, typed or from its folder -> the key that draws the course's numbers.

`cohort.json` is public and depends on the key, so whoever guesses the secret can confirm the guess
there. Hence the kit draws the secret itself (128 bit), and stretches any secret by scrypt [RFC
7914]: a guess takes a fifth of a second and 64 MiB instead of some microseconds.
"""

import hashlib
import os
import secrets
from functools import lru_cache
from pathlib import Path

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, read_text

SALT_FILE = "salt.txt"  # in a course's folder
MIN_SALT = 16  # characters of a typed secret
_COST = 1 << 16  # scrypt's N; with r = 8 it takes 64 MiB


def course_key(typed: str, folder: Path | None, *, make: bool = False) -> str:
    """The key of a course.

    Args:
        typed: a secret from the command line; empty for none.
        folder: the course's, whose `salt.txt` holds the secret; None for no such folder.
        make: draw a secret where the folder has none yet, readable for its owner only.

    Returns:
        64 hexadecimal digits; empty for the open course, without secret and folder.

    Raises:
        InputError: both are given, the folder has no secret, or a new secret is short.
    """
    if typed and folder is not None:
        raise InputError("--salt: expected it or --course, got both; keep the one in use")
    if folder is None:
        if make and typed:
            _require_long("--salt", typed)
        return stretch(typed) if typed else ""
    file = folder / SALT_FILE
    if not file.exists():
        if not make:
            raise InputError(
                f"{file}: expected the course's secret, found none; `falconwing labs release OUT "
                f"--course {folder}` makes it, or restore the one that the course began with"
            )
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(file, text=True) as handle:
            if hasattr(os, "fchmod"):
                os.fchmod(handle.fileno(), 0o600)
            handle.write(secrets.token_hex(16) + "\n")
    secret = read_text(file).strip()
    _require_long(str(file), secret)
    return stretch(secret)


def _require_long(name: str, secret: str) -> None:
    if len(secret) < MIN_SALT:
        raise InputError(
            f"{name}: expected at least {MIN_SALT} characters that cannot be guessed, "
            f"got {len(secret)}; leave it to the kit: --course FOLDER"
        )


def course_mark(key: str) -> str:
    """What tells a course's notebooks from another's, and nothing about its key; empty without."""
    return hashlib.sha256(f"{key}/mark".encode()).hexdigest()[:16] if key else ""


@lru_cache(maxsize=4)
def stretch(secret: str) -> str:
    """The key of a secret: 256 bit of scrypt, the same on every machine."""
    domain = b"falconwing-kit course"
    key = hashlib.scrypt(secret.encode(), salt=domain, n=_COST, r=8, p=1, maxmem=1 << 27, dklen=32)
    return key.hex()
