"""What is public stays public: no machine's paths, no package index, no unfinished marks, no large
files.
"""

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MAX_FILE_MB, MAX_TREE_MB = 16.0, 150.0
CPU_INDEX = b"download.pytorch." + b"org/whl/cpu"
# Written in pieces, so that this file does not hold what it looks for.
PRIVATE = {
    "path of one machine": r"(?<![\w.])/(?:wor"
    + r"k|roo"
    + r"t|home/\w+|Users/\w+)/|[A-Z]:\\Users\\",
    "package index": r"(?:--(?:extra-)?index-"
    + r"url|--find-"
    + r"links|--trusted-"
    + r"host)\b(?![= ]https://download\.pytorch\.org/whl/cpu\b)",
    "unfinished mark": r"\b(?:TO" + r"DO|FIX" + r"ME)\b",
}


def test_files_hold_nothing_private_or_unfinished():
    """A clone is read by strangers on other machines."""
    assert text_problems(ROOT, tracked_files(ROOT)) == []


def test_cpu_index_is_named_only_where_people_install():
    """PyTorch's public index of CPU builds is the one address, and no wheel asks for it."""
    named = [path for path in tracked_files(ROOT) if CPU_INDEX in path.read_bytes()]
    names = {path.relative_to(ROOT).as_posix() for path in named}
    assert names == {
        "environment.yml",
        "manual/site/install.md",
        "start.py",
        "tests/stories/pages.py",
    }


def test_files_stay_small():
    """A student's clone: one file under 16 MB, all of them under 150 MB."""
    assert size_problems(ROOT, tracked_files(ROOT)) == []


def tracked_files(tree: Path) -> list[Path]:
    """Files that git knows; in a copy without git, all but hidden folders."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=tree, capture_output=True, check=False)
    if listed.returncode == 0 and listed.stdout:
        return [
            tree / name
            for name in listed.stdout.decode().split("\0")
            if name and (tree / name).is_file()
        ]
    hidden = (".git", ".venv", "__pycache__")
    return [
        path
        for path in tree.rglob("*")
        if path.is_file() and not any(part in hidden for part in path.parts)
    ]


def text_problems(tree: Path, files: list[Path]) -> list[str]:
    """Lines that do not belong in public, with file and line.

    Args:
        tree: folder that the names are given against.
        files: what to read; files that are not text are passed over.
    """
    problems = []
    for path in files:
        content = path.read_bytes()
        if b"\0" in content[:8192]:
            continue
        for number, line in enumerate(content.decode("utf-8", "replace").splitlines(), 1):
            for what, pattern in PRIVATE.items():
                if re.search(pattern, line):
                    problems.append(f"{path.relative_to(tree).as_posix()}:{number}: {what}")
    return problems


def size_problems(tree: Path, files: list[Path]) -> list[str]:
    """Files that are too large, and the tree if it is."""
    sizes = {path: path.stat().st_size / 1e6 for path in files}
    problems = [
        f"{p.relative_to(tree).as_posix()}: {mb:.1f} MB"
        for p, mb in sizes.items()
        if mb >= MAX_FILE_MB
    ]
    total = sum(sizes.values())
    return problems + ([f"the tree: {total:.0f} MB"] if total >= MAX_TREE_MB else [])
