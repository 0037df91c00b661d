"""The site's sources: pages of the repository -> a folder that Sphinx builds, every link checked.

Pages stand once in the repository and are copied here with their links rewritten: to another page
of the site; to the published repository where `repository_url` names one; else the link's words
stay and its path is printed beside them. A link to nothing is an error with file and line. Nothing
is executed: outputs of the labs come from a cache that `falconwing labs selftest --outputs` wrote.
"""

import ast
import base64
import html
import json
import os
import re
import shutil
import struct
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SITE = Path(__file__).resolve().parent
ROOT = SITE.parents[1]
# Pages that stand elsewhere in the repository: path there -> place on the site. Every page of
# manual/site keeps its own place; any other manual/*.md becomes a how-to.
PLACES = {
    "README.md": "index.md",  # only as a link's target: the site has a front page of its own
    "manual/03_paper_map.md": "paper_map.md",
    "manual/classroom.md": "teaching/classroom.md",
    "manual/extend.md": "howto/extend.md",
    "manual/gallery.md": "gallery.md",
    "manual/glossary.md": "glossary.md",
    "manual/photos_to_simulator.md": "howto/hall.md",
    "labs/README.md": "labs/index.md",
    "labs/instructors.md": "teaching/instructors.md",
    "labs/course_plans.md": "teaching/course_plans.md",
    "hardware/README.md": "builder/hardware.md",
    "firmware/README.md": "builder/firmware.md",
    "falconwing_kit/README.md": "api/reading.md",
    "falconwing_kit/data/README.md": "data.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "LICENSES.md": "licences.md",
}
KIT = "falconwing_kit"
# On the page of a package that lists no public names.
FILES = """
Its names are imported from its files;
[the reading path](reading.md#every-file-one-line-each) has a line on each.
"""
PICTURES = {"image/png", "image/gif"}
MADE = {"manual/site/manual.pdf"}  # by the build, beside the pages that name it
_FENCE = re.compile(r"^(```+|~~~+).*?^\1[ \t]*$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(
    r"(?P<code>`+)[^`]+?(?P=code)|(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<to>[^)\s]+)\)"
)
_ELSEWHERE = re.compile(r"[a-z]+:|#")


@dataclass(frozen=True)
class Settings:
    """Where things are published; empty strings while they are not.

    Attributes:
        site_url: the site's address.
        repository_url: the repository's, such as a GitHub one.
    """

    site_url: str = ""
    repository_url: str = ""

    @classmethod
    def load(cls, path: Path = SITE.parent / "settings.toml") -> "Settings":
        """The settings of a file.

        Raises:
            RuntimeError: another key, or an address that is not one.
        """
        values = tomllib.loads(path.read_text(encoding="utf-8"))
        for key, value in values.items():
            if key not in cls.__dataclass_fields__:
                raise RuntimeError(f"{path.name}: expected site_url, repository_url, got {key}")
            if value and not re.fullmatch(r"https?://[^\s/]+(/[^\s]*)?", value):
                raise RuntimeError(f"{path.name}: {key}: expected https://..., got {value!r}")
        return cls(**{key: value.rstrip("/") for key, value in values.items()})

    def file_url(self, path: str, *, folder: bool = False) -> str:
        """The address of a file or folder of the repository; empty where there is none."""
        kind = "tree" if folder else "blob"
        return f"{self.repository_url}/{kind}/main/{path}" if self.repository_url else ""

    def launch_url(self, notebook: str) -> str:
        """The address at which a notebook of a GitHub repository runs; empty for any other."""
        host = "https://github.com/"
        if not self.repository_url.startswith(host):
            return ""
        owner = self.repository_url.removeprefix(host)
        return f"https://mybinder.org/v2/gh/{owner}/main?labpath={notebook}"


class Stage:
    """A folder of sources being written.

    Args:
        out: the folder, made anew.
        settings: where things are published.
        outputs: the labs' outputs, one JSON file per lab; it may be missing.
        root: the repository.
    """

    def __init__(self, out: Path, settings: Settings, outputs: Path, root: Path = ROOT) -> None:
        self.out, self.settings, self.outputs, self.root = out, settings, outputs, root
        self.places = page_places(root)
        self.problems: list[str] = []

    def write(self) -> None:
        """Everything but the configuration.

        Raises:
            RuntimeError: links that lead nowhere, one line each.
        """
        shutil.rmtree(self.out, ignore_errors=True)
        (self.out / "_static").mkdir(parents=True)
        shutil.copy(SITE / "style.css", self.out / "_static")
        shutil.copy(SITE / "conf.py", self.out)
        for source, place in self.places.items():
            if source.endswith(".md") and source != "README.md":
                self.put(place, self.page(source))
        folders = sorted((self.root / "labs").glob("lab[0-9]*"))
        for folder in folders:
            self.put(f"labs/{folder.name[:5]}.ipynb", self.lab(folder))
        self.list("labs/index.md", [folder.name[:5] for folder in folders])
        named = {*PLACES.values()} | {f"howto/{p.name}" for p in (SITE / "howto").glob("*.md")}
        others = [p for p in self.places.values() if p.startswith("howto/") and p not in named]
        self.list("howto/index.md", [Path(p).stem for p in others])
        faces = {path.parent.name: path for path in (self.root / KIT).glob("*/__init__.py")}
        packages = sorted(faces.keys() - {"tools"})
        for name in packages:
            self.put(f"api/{name}.md", api_page(name, faces[name]))
        lines = [f"- [{KIT}.{name}]({name}.md): {purpose(faces[name])}" for name in packages]
        self.put(
            "api/index.md", self.page("manual/site/api/index.md") + "\n" + "\n".join(lines) + "\n"
        )
        self.list("api/index.md", packages)
        if self.problems:
            raise RuntimeError("\n".join(self.problems))

    def put(self, place: str, text: str) -> None:
        """One file of the stage."""
        path = self.out / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def list(self, place: str, pages: list[str]) -> None:
        """Further pages in a page's table of contents."""
        if pages:
            text = (self.out / place).read_text(encoding="utf-8")
            contents = "\n".join(pages)
            self.put(place, f"{text}\n```{{toctree}}\n:hidden:\n\n{contents}\n```\n")

    def page(self, source: str) -> str:
        """A Markdown page with its links as the site has them."""
        text = (self.root / source).read_text(encoding="utf-8")
        return self.rewrite(text, source, self.places[source])

    def rewrite(self, text: str, source: str, place: str) -> str:
        """Links of a page, given where it stands in the repository and on the site."""

        whole = text

        def replace(found: re.Match[str]) -> str:
            if found["code"] or _ELSEWHERE.match(found["to"]):
                return found[0]
            path, _, anchor = found["to"].partition("#")
            target = os.path.normpath(os.path.join(os.path.dirname(source), path))
            if target in MADE:
                return found[0]
            if target.startswith("..") or not (self.root / target).exists():
                line = whole.count("\n", 0, whole.index(found[0])) + 1
                self.problems.append(
                    f"{source}:{line}: expected a link to a file of the repository, got {path}"
                )
                return found[0]
            if found["image"]:
                return f"![{found['text']}]({self.image(target, place)})"
            return self.link(found["text"], target, anchor, place)

        return outside_fences(text, lambda prose: _LINK.sub(replace, prose))

    def image(self, target: str, place: str) -> str:
        """Take a picture of the repository along; its address from a page."""
        copy = Path("pictures") / target.replace("/", "_")
        (self.out / copy).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(self.root / target, self.out / copy)
        return os.path.relpath(copy, os.path.dirname(place) or ".")

    def link(self, text: str, target: str, anchor: str, place: str) -> str:
        """A link to a page of the site, to the published repository, or none."""
        page = self.places.get(target) or self.places.get(f"{target}/README.md")
        if page:
            to = os.path.relpath(page, os.path.dirname(place) or ".")
            return f"[{text}]({to}{'#' + anchor if anchor else ''})"
        url = self.settings.file_url(target, folder=(self.root / target).is_dir())
        if url:
            return f"[{text}]({url})"
        path = f"`{target}`"
        if "/" in text and text.strip("`") in target:
            return path
        return text if target in text else f"{text} ({path})"

    def lab(self, folder: Path) -> str:
        """A lab's notebook as students get it, with the outputs of the cache below its cells."""
        name = folder.name[:5]
        source = f"labs/{folder.name}/{name}.ipynb"
        notebook = json.loads((self.root / source).read_text(encoding="utf-8"))
        cache = self.outputs / f"{folder.name}.json"
        known = json.loads(cache.read_text(encoding="utf-8")) if cache.is_file() else {}
        for cell in notebook["cells"]:
            text = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                cell["source"] = self.rewrite(text, source, f"labs/{name}.ipynb")
            elif "exercise" not in cell["metadata"]:
                cell["outputs"] = [*map(sized, known.get(text, []))]
                cell["metadata"]["mystnb"] = {"image": image_of(cell)}
                if "check" in cell["metadata"]:  # sentences, which may go on in the next line
                    cell["metadata"]["tags"] = [*cell["metadata"].get("tags", []), "check"]
        notebook["cells"].insert(1, markdown_cell(self.lab_head(folder, bool(known))))
        return json.dumps(notebook)

    def lab_head(self, folder: Path, with_outputs: bool) -> str:
        """Where the notebook is, where it can be opened, and whose outputs stand below."""
        name = f"labs/{folder.name}/{folder.name[:5]}.ipynb"
        links = [
            ("Notebook", self.settings.file_url(name)),
            ("Run it", self.settings.launch_url(name)),
        ]
        shown = " | ".join(f"[{text}]({url})" for text, url in links if url) or f"`{name}`"
        outputs = (
            "Outputs are those of the solution, which is not shown."
            if with_outputs
            else "Shown without outputs; run it to see them."
        )
        return f"```{{note}}\n{shown}\n\n{outputs}\n```"


def page_places(root: Path) -> dict[str, str]:
    """Every page: path in the repository -> place on the site."""
    here = "manual/site/"
    own = {p.relative_to(root).as_posix() for p in (root / here).rglob("*.md")}
    others = {f"manual/{p.name}" for p in (root / "manual").glob("*.md")}
    return (
        {page: page.removeprefix(here) for page in sorted(own)}
        | {page: f"howto/{Path(page).name}" for page in sorted(others)}
        | {page: place for page, place in PLACES.items() if (root / page).is_file()}
        | {
            f"labs/{p.parent.name}/{p.name}": f"labs/{p.stem}.ipynb"
            for p in sorted((root / "labs").glob("lab[0-9]*/lab[0-9]*.ipynb"))
        }
    )


def outside_fences(text: str, change: Callable[[str], str]) -> str:
    """A page with its prose changed and its fenced blocks as they are."""
    parts, at = [], 0
    for fence in _FENCE.finditer(text):
        parts += [change(text[at : fence.start()]), fence[0]]
        at = fence.end()
    return "".join([*parts, change(text[at:])])


def markdown_cell(text: str) -> dict[str, Any]:
    """A cell of a notebook."""
    return {"cell_type": "markdown", "id": "site-head", "metadata": {}, "source": text}


def image_of(cell: dict[str, Any]) -> dict[str, str]:
    """Words, width and class of a cell's picture: a film has its own words and width."""
    found = {"alt": drawn_by(cell["metadata"])}
    for output in cell["outputs"]:
        for kind, said in output.get("metadata", {}).items():
            if "alt" in said:
                found |= {"alt": said["alt"]}
                found |= {"width": f"{said['width']}px"} if "width" in said else {}
            if kind in PICTURES and is_wide(output.get("data", {}).get(kind, "")):
                found["classes"] = "wide"
    return found


def sized(output: dict[str, Any]) -> dict[str, Any]:
    """A cell's output, in which a wide picture without a width has that of the text on a laptop."""
    for kind in PICTURES & output.get("data", {}).keys():
        if is_wide(output["data"][kind]):
            metadata = output.get("metadata", {})
            return {
                **output,
                "metadata": {**metadata, kind: {"width": 736} | metadata.get(kind, {})},
            }
    return output


def is_wide(picture: str | list[str]) -> bool:
    """Whether a PNG or GIF, in base64, is too large or too wide to be read across a phone."""
    data = base64.b64decode("".join(picture))
    form, at = ("<HH", 6) if data[:3] == b"GIF" else (">II", 16)
    if len(data) < at + struct.calcsize(form):
        return False
    width, height = struct.unpack_from(form, data, at)
    return width > 600 and (width > 900 or width > 1.9 * height)


def drawn_by(metadata: dict[str, Any]) -> str:
    """Words for a picture that a cell draws; a figure of the lab has a name."""
    name = metadata.get("figure", "")
    return f"Drawn by the cell above{': figure ' + name if name else ''}"


def purpose(face: Path) -> str:
    """First paragraph of a package's docstring, without the package's name before it."""
    text = ast.get_docstring(ast.parse(face.read_text(encoding="utf-8"))) or ""
    words = " ".join(text.split("\n\n")[0].split())
    return words.removeprefix(f"{face.parent.name}: ").replace("_", "\\_")


def api_page(name: str, face: Path) -> str:
    """The public names of a package, described by their docstrings."""
    module = f"{KIT}.{name}"
    title = module.replace(".", ".\u200b")  # where a phone may end the line
    files = "" if "__all__" in face.read_text(encoding="utf-8") else FILES
    return (
        f"# {title}\n\n```{{eval-rst}}\n.. automodule:: {module}\n"
        f"   :members:\n   :imported-members:\n```\n{files}"
    )


def book_pages(page: str, stage: Stage) -> None:
    """The builder's book: typst's one HTML page -> a page for each chapter, pictures as files."""
    body = page.partition("</nav>")[2].rpartition("</body>")[0]
    chapters = re.split(r"(?=<h2 id=)", body)[1:]
    titles = [html.unescape(re.search(r"<h2[^>]*>(.*?)</h2>", text)[1]) for text in chapters]
    names = [f"{number:02d}" for number in range(1, len(chapters) + 1)]
    owner = {
        anchor: name
        for name, text in zip(names, chapters, strict=True)
        for anchor in re.findall(r'\bid="([^"]+)"', text)
    }
    for name, title, text in zip(names, titles, chapters, strict=True):
        text = text.partition("</h2>")[2]
        text = re.sub(r'src="data:image/([\w+]+);base64,([^"]+)"', _extract(stage), text)
        text = re.sub(
            r'href="#([^"]+)"',
            lambda found: f'href="{owner[found[1]]}.html#{found[1]}"',
            text,
        )
        text = re.sub(r"(</?h)([3-6])", lambda found: f"{found[1]}{int(found[2]) - 1}", text)
        anchor = next(a for a, page in owner.items() if page == name)
        stage.put(
            f"builder/{name}.md",
            f"# {title}\n\n`````{{raw}} html\n"
            f'<div class="book" id="{anchor}">{text}</div>\n`````\n',
        )


def _extract(stage: Stage) -> Callable[[re.Match[str]], str]:
    """A replacement that writes a picture of the page to a file, and names that file."""

    def replace(found: re.Match[str]) -> str:
        data = base64.b64decode(found[2])
        folder = stage.out / "_static" / "book"
        folder.mkdir(exist_ok=True)
        name = f"{len(list(folder.iterdir())) + 1:02d}.{found[1].removesuffix('+xml')}"
        (folder / name).write_bytes(data)
        return f'src="../_static/book/{name}"'

    return replace
