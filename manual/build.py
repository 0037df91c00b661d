"""The manual, built: manual.typ and what it reads -> manual.pdf and manual.html, offline, in a few
seconds.

    .venv/bin/python manual/build.py              into build/manual
    .venv/bin/python manual/build.py --out here

Needs the extra `manual` (typst, one wheel). Both files are products and not kept in git. Figures
are taken as they are; figures/make_figures.py makes them again.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent


def main(words: list[str] | None = None) -> int:
    """Build both.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0 done, 1 typst is missing or the source has a mistake.
    """
    parser = argparse.ArgumentParser(description="Build the manual as PDF and HTML.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "build" / "manual", help="folder to write to"
    )
    out = parser.parse_args(words).out
    try:
        pages = build(out)
    except ModuleNotFoundError as missing:
        print(
            f'manual: expected {missing.name}, got none; pip install -c constraints.txt -e ".[manual]"',
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
    """Write both files whole.

    Args:
        out: the folder; made where it is missing.

    Returns:
        The PDF and the HTML.

    Raises:
        RuntimeError: the source has a mistake; its line and a hint are in the text.
    """
    from falconwing_kit.core.files import atomic_write

    out.mkdir(parents=True, exist_ok=True)
    paths = out / "manual.pdf", out / "manual.html"
    for path in paths:
        with atomic_write(path) as file:
            file.write(compiled(path.suffix[1:]))
    return paths


def compiled(form: str, **options: Any) -> Any:
    """The manual in one form, with the fonts that typst and matplotlib bring and no other.

    Args:
        form: "pdf", "html" or "png" (a list, one a page).
        options: handed to typst.compile, such as ppi.

    Returns:
        Its bytes.

    Raises:
        RuntimeError: the source has a mistake.
    """
    import typst

    return typst.compile(str(FOLDER / "manual.typ"), format=form, **where(), **options)


def where() -> dict[str, Any]:
    """What every call of typst needs: the root that paths begin at, and the fonts."""
    import matplotlib

    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return {"root": str(ROOT), "font_paths": [str(fonts)], "ignore_system_fonts": True}


if __name__ == "__main__":
    sys.exit(main())
