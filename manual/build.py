"""Build of manual and site, offline: manual.typ -> manual.pdf, manual.html; all pages -> the site.

    .venv/bin/python manual/build.py              the manual, into build/manual, in seconds
    .venv/bin/python manual/build.py --out here
    .venv/bin/python manual/build.py site         the site; then open build/site/index.html
    .venv/bin/python manual/build.py slides       slides, handout and walk-through of each lab

The manual needs the extra `manual` (typst, one wheel), the site the extra `site`, the slides also
`labs`. None is kept in git. Figures are redrawn by figures/make_figures.py and
hardware/assembly/draw.py only; the site and the slides show the labs' outputs if
`falconwing labs selftest --outputs build/lab_outputs` has written them.
"""

import argparse
import json
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent
ASSEMBLY_CHAPTER = 4  # whose steps have codes of their own
EXTRA = {"slides": "manual,labs"}  # where it is not called as what is built
MAX_CHAPTERS = 60  # codes are made for so many and used by those that there are
sys.path[:0] = [str(FOLDER / "site"), str(FOLDER)]

if TYPE_CHECKING:
    from stage import Settings


def main(words: list[str] | None = None) -> int:
    """Build one of them; 0 done, 1 if a library is missing or the source has an error."""
    parser = argparse.ArgumentParser(description="Build the manual, the site, or the slides.")
    parser.add_argument("what", nargs="?", choices=("manual", "site", "slides"), default="manual")
    parser.add_argument("--out", type=Path, help="folder to write to; build/WHAT if not given")
    settings = parser.parse_args(words)
    out = settings.out or ROOT / "build" / settings.what
    try:
        pages = {"manual": build, "site": build_site, "slides": build_slides}[settings.what](out)
    except ModuleNotFoundError as missing:
        print(
            f"{settings.what}: expected {missing.name}, got none; "
            f'pip install -c constraints.txt -e ".[{EXTRA.get(settings.what, settings.what)}]"',
            file=sys.stderr,
        )
        return 1
    except RuntimeError as mistake:
        print(f"{settings.what}: {mistake}", file=sys.stderr)
        return 1
    for path in pages:
        print(f"{path}: {size_mb(path):.1f} MB")
    return 0


def build(out: Path) -> tuple[Path, ...]:
    """Write the PDF and the HTML to a folder, which is created; their paths.

    Raises:
        RuntimeError: the source has an error; the message has its line and a hint.
    """
    from falconwing_kit.core.files import atomic_write

    out.mkdir(parents=True, exist_ok=True)
    paths = out / "manual.pdf", out / "manual.html"
    for path in paths:
        with atomic_write(path) as file:
            file.write(compiled(path.suffix[1:]))
    return paths


def build_site(out: Path) -> tuple[Path, ...]:
    """Write the site to a folder, which is made anew; the path of its front page.

    Raises:
        RuntimeError: a page has an error or a dead link; or the folder holds something else.
    """
    if out.exists() and any(out.iterdir()) and not (out / "searchindex.js").is_file():
        raise RuntimeError(f"expected an empty folder or an older site, got {out}; name another")
    from render import render

    render(out.resolve(), compiled)
    return (out / "index.html",)


def build_slides(out: Path) -> tuple[Path, ...]:
    """Write slides, handout and walk-through of each lab; their paths.

    Raises:
        RuntimeError: a source has an error; the message has its line and a hint.
    """
    import typst
    from lectures import build_lectures

    def compile_one(source: Path, inputs: dict[str, str]) -> Any:
        return typst.compile(str(source), format="pdf", sys_inputs=inputs, **where())

    return tuple(build_lectures(out, compile_one))


def compiled(form: str, settings: "Settings | None" = None, **options: Any) -> Any:
    """The manual's bytes as "pdf", "html" or "png" (a list of pages), with bundled fonts only.

    Args:
        form: one of these.
        settings: where things are published; manual/settings.toml if not given.

    Raises:
        RuntimeError: the source or the settings have an error.
    """
    import typst
    from stage import Settings

    inputs = {"published": json.dumps(published(settings or Settings.load()))}
    return typst.compile(
        str(FOLDER / "manual.typ"), format=form, sys_inputs=inputs, **where(), **options
    )


def published(settings: "Settings") -> dict[str, Any]:
    """What the manual prints of the settings, nothing where they are empty.

    Returns:
        codes: a QR code for the site's page of each chapter, by the chapter's number, as SVG with
            its address; steps: the same for each step of the assembly, by its id; labs: name and
            address of each notebook that can be launched.
    """
    from falconwing_kit.tools.classroom.qr import qr_svg

    def code(url: str) -> dict[str, str]:
        return {"url": url, "svg": qr_svg(url).decode("utf-8")}

    codes, steps = {}, {}
    if settings.site_url:
        book = f"{settings.site_url}/builder"
        for number in range(1, MAX_CHAPTERS + 1):
            codes[str(number)] = code(f"{book}/{number:02d}.html")
        for step in tomllib.loads((FOLDER / "assembly.toml").read_text("utf-8"))["steps"]:
            place = f"{ASSEMBLY_CHAPTER:02d}.html#step-{step['id']}"
            steps[step["id"]] = code(f"{book}/{place}")
    notebooks = sorted((ROOT / "labs").glob("lab[0-9]*/lab[0-9]*.ipynb"))
    labs = [
        {"name": path.stem, "url": settings.launch_url(path.relative_to(ROOT).as_posix())}
        for path in notebooks
    ]
    return {"codes": codes, "steps": steps, "labs": [lab for lab in labs if lab["url"]]}


def size_mb(path: Path) -> float:
    """Size of a file, or of the whole site for its front page."""
    files = path.parent.rglob("*") if path.name == "index.html" else [path]
    return sum(file.stat().st_size for file in files if file.is_file()) / 1e6


def where() -> dict[str, Any]:
    """Arguments of every call of typst: root of the paths, and fonts."""
    import matplotlib

    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return {"root": str(ROOT), "font_paths": [str(fonts)], "ignore_system_fonts": True}


if __name__ == "__main__":
    sys.exit(main())
