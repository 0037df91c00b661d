"""The site: the repository's pages and docstrings -> a folder of HTML, checked for dead links."""

import re
import shutil
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import unquote, urlsplit

from stage import SITE, Settings, Stage, book_pages

OUTPUTS = SITE.parents[1] / "build" / "lab_outputs"


def render(
    out: Path,
    book: Callable[[str, Settings], bytes],
    *,
    settings: Settings | None = None,
    outputs: Path = OUTPUTS,
) -> None:
    """Write the site, with the builder's book as pages and as PDF.

    Args:
        out: folder to write to, made anew when the new pages are without a fault.
        book: the manual's bytes as "html" or "pdf", with these settings.
        settings: where things are published; manual/settings.toml if not given.
        outputs: the cache of the labs' outputs; it may be missing.

    Raises:
        ModuleNotFoundError: Sphinx, its theme or myst-nb is not installed.
        RuntimeError: a dead link, or something that Sphinx warns of; one line each.
    """
    settings = settings or Settings.load()
    with TemporaryDirectory() as folder:
        sources, pages = Path(folder) / "sources", Path(folder) / "pages"
        stage = Stage(sources, settings, outputs)
        stage.write()
        book_pages(book("html", settings).decode("utf-8"), stage)
        (sources / "manual.pdf").write_bytes(book("pdf", settings))
        sphinx(sources, pages, settings)
        problems = dead_links(pages)
        if problems:
            raise RuntimeError("\n".join(problems))
        shutil.rmtree(out, ignore_errors=True)
        shutil.move(pages, out)


def sphinx(sources: Path, out: Path, settings: Settings) -> None:
    """Sphinx's own build, in which a warning is an error.

    Raises:
        RuntimeError: with its warnings.
    """
    import furo  # noqa: F401  # so that a missing one is named before the work begins
    import myst_nb  # noqa: F401
    from sphinx.cmd.build import build_main

    words = ["-W", "--keep-going", "-q", "-b", "html", "-d", f"{sources}/.doctrees"]
    if settings.site_url:
        words += ["-D", f"html_baseurl={settings.site_url}/"]
    if settings.repository_url:
        words += ["-D", f"html_theme_options.source_repository={settings.repository_url}"]
    said = StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        code = build_main([*words, str(sources), str(out)])
    if code:
        text = re.sub(r"\x1b\[[\d;]*m", "", said.getvalue()).replace(f"{sources}/", "")
        raise RuntimeError(text.strip())
    (out / ".buildinfo").unlink(missing_ok=True)


class Links(HTMLParser):
    """What a page links to, and the places in it that can be linked to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect `href`, `src` and `id`."""
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.targets.append(value)
            elif name == "id" and value:
                self.ids.add(value)


def dead_links(site: Path) -> list[str]:
    """Links of a folder of HTML to files or places that are not in it, one line each.

    Addresses elsewhere (`https:`, `mailto:`, data) are not looked up.
    """
    pages = {path: Links(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    problems = []
    for path, page in sorted(pages.items()):
        for target in page.targets:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = path if not parts.path else (path.parent / unquote(parts.path)).resolve()
            file = file / "index.html" if file.is_dir() else file
            place = unquote(parts.fragment)
            if not file.is_file() or (place and file in pages and place not in pages[file].ids):
                problems.append(f"{path.relative_to(site).as_posix()}: dead link {target}")
    return problems


if __name__ == "__main__":
    sys.exit("type: python manual/build.py site")
