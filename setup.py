"""Files beside the package -> what a wheel takes along, for `core.files.shipped_path` to find."""

import os
from collections.abc import Iterator

from setuptools import setup

FOLDERS = ("firmware", "hardware", "labs")
PRODUCTS = {"__pycache__", ".ipynb_checkpoints", "build"}


def shipped_files() -> Iterator[tuple[str, list[str]]]:
    """Folder under the installation's prefix, and the files that go there."""
    for top in FOLDERS:
        for folder, inner, names in os.walk(top):
            inner[:] = sorted(set(inner) - PRODUCTS)
            files = [f"{folder}/{name}" for name in sorted(names) if not name.startswith(".")]
            yield f"share/falconwing_kit/{folder}".replace(os.sep, "/"), files


setup(data_files=list(shipped_files()))
