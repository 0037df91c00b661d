"""Build of the manual: manual.typ and its parts -> manual.pdf and manual.html, offline, in seconds.

    .venv/bin/python manual/build.py              into build/manual
    .venv/bin/python manual/build.py --out here

Needs the extra `manual` (typst, one wheel). Neither file is kept in git. Figures are redrawn by
figures/make_figures.py only.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent


def main(words: list[str] | None = None) -> int:
    """Build both; 0 done, 1 if typst is missing or the source has an error."""
    parser = argparse.ArgumentParser(description="Build the manual as PDF and HTML.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "build" / "manual", help="folder to write to"
    )
    out = parser.parse_args(words).out
    try:
        pages = build(out)
    except ModuleNotFoundError as missing:
        print(
            f"manual: expected {missing.name}, got none; "
            'pip install -c constraints.txt -e ".[manual]"',
            file=sys.stderr,
        )
        return 1
    except RuntimeError as mistake:
        print(f"manual: {mistake}", file=sys.stderr)
        return 1
    for path in pages:
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    return 0


def build(out: Path) -> tuple[Path, Path]:
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


def compiled(form: str, **options: Any) -> Any:
    """The manual's bytes as "pdf", "html" or "png" (a list of pages), with bundled fonts only.

    Raises:
        RuntimeError: the source has an error.
    """
    import typst

    return typst.compile(str(FOLDER / "manual.typ"), format=form, **where(), **options)


def where() -> dict[str, Any]:
    """Arguments of every call of typst: root of the paths, and fonts."""
    import matplotlib

    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return {"root": str(ROOT), "font_paths": [str(fonts)], "ignore_system_fonts": True}


if __name__ == "__main__":
    sys.exit(main())
