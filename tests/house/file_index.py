"""The book's files -> the index of falconwing_kit/README.md: the first docstring line of each file.

python tests/house/file_index.py           prints the index
python tests/house/file_index.py --write   writes it into the page
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "falconwing_kit" / "README.md"
HEAD = "## Every file, one line each\n"


def index() -> str:
    """The section of the page, with its heading."""
    package, text = ROOT / "falconwing_kit", [HEAD]
    for room in sorted(path.parent for path in package.glob("*/__init__.py")):
        if room.name in ("tools", "data"):
            continue
        text += [f"**{room.name}**\n", "| file | in -> out |", "|---|---|"]
        for path in sorted(room.rglob("*.py")):
            if path.name != "__init__.py":
                name = path.relative_to(room).as_posix()
                text.append(f"| `{name}` | {summary(path)} |")
        text.append("")
    return "\n".join(text)


def summary(path: Path) -> str:
    """The first paragraph of a file's docstring, on one line, without the file's own name."""
    doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(doc.split("\n\n")[0].split()).replace("|", "\\|")


def main(words: list[str]) -> int:
    """Print or write the index."""
    if words == ["--write"]:
        page = PAGE.read_text(encoding="utf-8").split(HEAD)[0]
        PAGE.write_text(page + index(), encoding="utf-8")
    else:
        print(index())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
