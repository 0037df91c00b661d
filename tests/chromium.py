"""Headless Chromium for tests of pages: without it they fail in CI and are skipped elsewhere."""

import importlib.util
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@contextmanager
def headless_chromium(flags: Sequence[str] = ()) -> Iterator[Any]:
    """A running browser with these further flags."""
    for what, there in (
        ("chromium", CHROMIUM),
        ("playwright", importlib.util.find_spec("playwright")),
    ):
        if not there:
            (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(
                f"expected {what}, found none"
            )
    from playwright.sync_api import sync_playwright

    if hasattr(os, "geteuid") and os.geteuid() == 0:
        flags = [*flags, "--no-sandbox"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(flags))
        yield browser
        browser.close()
