"""Hosted notebooks: labs -> one notebook each for a Python in the cloud, with its files inside.

OUT/lab03.ipynb                               installs the kit and unpacks its files
OUT/falconwing_kit-0.2.0-py3-none-any.whl     the kit, to upload beside the notebook

With the repository's address the kit is installed from there, unless its wheel lies beside the
notebook.
"""

import base64
import io
import json
import mimetypes
import re
import shutil
import tempfile
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import falconwing_kit
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.collect import MAX_CODE
from falconwing_kit.tools.grading.find import notebook_path
from falconwing_kit.tools.grading.release import release_lab
from falconwing_kit.tools.grading.wheel import WHEEL_NAME, write_kit_wheel

IN_BROWSER = ("lab01", "lab02", "lab04", "lab05", "lab07", "lab11", "lab12")  # need no hosted one
ROOM = 100_000  # characters of a notebook that are left to the lab's text and the student
LINE = 2000  # characters of a line of the packed files
_FIRST_CELL = '''\
#@title Run this cell first: it installs the kit and unpacks this lab's files
import base64, importlib.util, io, os, subprocess, sys, zipfile
from pathlib import Path

LAB, REPOSITORY = {lab!r}, {repository!r}
if importlib.util.find_spec("falconwing_kit") is None:
    wheels = sorted(Path().glob("falconwing_kit-*.whl"))
    if not wheels and not REPOSITORY:
        raise FileNotFoundError(
            "{wheel} is not beside this notebook: upload it "
            "there, your course hands it out with the notebook, and run this cell again"
        )
    kit = wheels[-1].resolve().as_uri() if wheels else "git+" + REPOSITORY
    words = ["install", "--quiet", "falconwing-kit{extra} @ " + kit]
    subprocess.run([sys.executable, "-m", "pip", *words], check=True)
    importlib.invalidate_caches()

FILES = """
{files}
"""
if Path.cwd().name != LAB:
    zipfile.ZipFile(io.BytesIO(base64.b64decode(FILES))).extractall(LAB)
    os.chdir(LAB)
if "" not in sys.path:
    sys.path.insert(0, "")
'''


def hosted_notebooks(
    folders: Sequence[Path], out: Path, salt: str = "", repository: str = ""
) -> list[Path]:
    """Write the notebooks and the kit's wheel, complete or not at all.

    Args:
        folders: of the labs.
        out: a new or empty folder.
        salt: the course's key, as of `release`.
        repository: where the kit is published, such as https://github.com/OWNER/falconwing-kit.

    Returns:
        The files.

    Raises:
        InputError: `out` is not empty, the address is not one, or a lab cannot be used.
    """
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise InputError(f"{out}: expected a new or an empty folder; choose another")
    if repository and not re.fullmatch(r"https://[^\s/\"]+/[^\s\"]+", repository):
        raise InputError(f"repository: expected https://..., got {repository!r}")
    part = out.with_name(f".{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        write_kit_wheel(part)
        for folder in folders:
            text = hosted_text(folder, salt, repository)
            with atomic_write(part / notebook_path(folder).name, text=True) as handle:
                handle.write(text)
        if out.is_dir():
            out.rmdir()
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return sorted(out.iterdir())


def hosted_text(folder: Path, salt: str = "", repository: str = "") -> str:
    """Text of a lab's notebook with the cell that installs and unpacks."""
    name = folder.resolve().name
    with tempfile.TemporaryDirectory() as place:
        lab = Path(place) / name
        release_lab(folder, lab, salt)
        file = notebook_path(lab)
        notebook = json.loads(file.read_text(encoding="utf-8"))
        file.unlink()
        attach_pictures(notebook, lab)
        packed = base64.b64encode(_zip(lab)).decode()
    lines = [packed[i : i + LINE] for i in range(0, len(packed), LINE)]
    cell = _FIRST_CELL.format(
        lab=name,
        repository=repository,
        wheel=WHEEL_NAME,
        extra="[torch]" if _needs_torch(folder) else "",
        files="\n".join(lines),
    )
    if len(cell) > MAX_CODE - ROOM:
        raise InputError(
            f"{name}: expected files of at most {(MAX_CODE - ROOM) // 1000} kB as text, got "
            f"{len(cell) // 1000} kB, more than `grade` reads; make the lab's data smaller"
        )
    notebook["cells"].insert(_first_code(notebook), _code_cell(cell))
    return json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def _needs_torch(folder: Path) -> bool:
    """Whether the notebook or its given code imports it, at the top or in a function."""
    texts = [(folder / name).read_text(encoding="utf-8") for name in ("lab.py", "given.py")]
    return any(re.search(r"^\s*(import|from) torch\b", text, re.MULTILINE) for text in texts)


def published_repository() -> str:
    """`repository_url` of a checkout's manual/settings.toml; empty where there is none."""
    path = Path(falconwing_kit.__file__).resolve().parents[1] / "manual" / "settings.toml"
    if not path.is_file():
        return ""
    return str(tomllib.loads(path.read_text(encoding="utf-8")).get("repository_url", ""))


def attach_pictures(notebook: dict[str, Any], lab: Path) -> None:
    """Put the lab's pictures that a text shows into the cell: no file lies beside the notebook."""
    for cell in notebook["cells"]:
        text = "".join(cell["source"]) if cell["cell_type"] == "markdown" else ""
        for name in set(re.findall(r"!\[[^\]]*\]\(([\w.-]+)\)", text)):
            kind = mimetypes.guess_type(name)[0] or "image/webp"
            data = base64.b64encode((lab / name).read_bytes()).decode()
            cell.setdefault("attachments", {})[name] = {kind: data}
            text = text.replace(f"]({name})", f"](attachment:{name})")
        if "attachments" in cell:
            cell["source"] = text.splitlines(keepends=True)


def _first_code(notebook: dict[str, Any]) -> int:
    kinds = [cell["cell_type"] for cell in notebook["cells"]]
    return kinds.index("code") if "code" in kinds else len(kinds)


def _code_cell(text: str) -> dict[str, Any]:
    """A cell whose source JupyterLab and Colab fold away."""
    return {
        "cell_type": "code",
        "id": "cell-hosted",
        "metadata": {"cellView": "form", "jupyter": {"source_hidden": True}},
        "source": text.splitlines(keepends=True),
        "execution_count": None,
        "outputs": [],
    }


def _zip(folder: Path) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(each for each in folder.rglob("*") if each.is_file()):
            entry = zipfile.ZipInfo(file.relative_to(folder).as_posix(), (1980, 1, 1, 0, 0, 0))
            entry.external_attr, entry.compress_type = 0o644 << 16, zipfile.ZIP_DEFLATED
            archive.writestr(entry, file.read_bytes())
    return content.getvalue()
