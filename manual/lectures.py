"""Lectures: labs/labNN/lecture.typ and the lab's own files -> slides, handout, walk-through.

What the walk-through and some slides show is read here: solutions from the solution notebook,
mistakes and questions from notes.md, points from checks.py, the quiz, and the figures that
`falconwing labs selftest --outputs build/lab_outputs` has drawn, where it has.
"""

import base64
import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent
OUTPUTS = ROOT / "build" / "lab_outputs"
FIGURES = ROOT / "build" / "lecture_figures"
FORMS = ("slides", "handout", "walkthrough")
_SPECIAL = re.compile(r"([\\#$*_<>@\[\]~`/\"'=+\-])")
_INLINE = re.compile(
    r"``?([^`]+)``?|\*\*([^*]+)\*\*|(?<!\w)\*([^*\s](?:[^*]*[^*\s])?)\*(?!\w)|\$([^$]+)\$"
)


def sources() -> list[Path]:
    """The lectures' sources, in the order of the labs."""
    return sorted((ROOT / "labs").glob("lab[0-9]*/lecture.typ"))


def build_lectures(out: Path, compile_one: Any) -> list[Path]:
    """Write the three PDFs of each lecture.

    Args:
        out: folder, made if it is not there.
        compile_one: typst.compile with the build's own arguments: (source, inputs) -> bytes.
    """
    from falconwing_kit.core.files import atomic_write

    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for source in sources():
        data = json.dumps(lab_data(source.parent))
        for form in FORMS:
            path = out / f"{source.parent.name.split('_')[0]}_{form}.pdf"
            with atomic_write(path) as file:
                file.write(compile_one(source, {"form": form, "lab": data}))
            paths.append(path)
    return paths


def lab_data(folder: Path) -> dict[str, Any]:
    """What lectures.typ shows of a lab, as numbers and Typst markup."""
    from falconwing_kit.tools.grading.find import load_checks, notebook_path
    from falconwing_kit.tools.grading.lab import course_constants
    from falconwing_kit.tools.grading.quiz import read_quiz

    lab = load_checks(folder)
    cells = json.loads(notebook_path(folder, solution=True).read_text("utf-8"))["cells"]
    notes = (folder / "notes.md").read_text("utf-8")
    quiz = read_quiz(folder, "", course_constants(lab, ""))
    return {
        "number": int(lab.name[3:]),
        "title": lab.title[:1].upper() + lab.title[1:],
        "hours": f"{lab.hours:g}",
        "goals": _goals("".join(cells[0]["source"])),
        "goals_note": typst_of("**Goals.** " + _start(notes, "Goals")),
        "time_note": typst_of("**Time.** " + _start(notes, "Time")),
        "exercises": [
            {
                "name": each.name,
                "points": f"{each.points:g}",
                "claims": [typst_of(check.claim) for check in each.checks],
                **_solution(cells, each.name),
            }
            for each in lab.exercises
        ],
        "mistakes": [
            [typst_of(mistake), typst_of(check), _exercise_of(lab, check)]
            for mistake, check in _mistakes(notes)
        ],
        "questions": [[typst_of(part) for part in pair] for pair in _questions(notes)],
        "figures": dict(_figures(folder, cells)),
        "figure_notes": typst_of(_section(notes, "solution figure", "solution's figure")),
        "quiz": [
            {
                "text": typst_of(each.text),
                "answer": typst_of(_answer(each)),
                "explanation": typst_of(each.explanation),
            }
            for each in quiz
        ],
    }


def typst_of(text: str) -> str:
    """Markdown of one paragraph as Typst: code, emphasis, short formulas; all else escaped.

    A table stays out: its lines are dropped.
    """
    kept = [line for line in text.split("\n") if not line.startswith("|")]
    plain, parts, end = " ".join(" ".join(kept).split()), [], 0
    for found in _INLINE.finditer(plain):
        parts.append(_escaped(plain[end : found.start()]))
        code, strong, emphasis, formula = found.groups()
        if code or formula:
            shown = (code or _readable(formula)).replace("\\", "\\\\").replace('"', '\\"')
            parts.append(f'#raw("{shown}")' if code else f'#emph("{shown}")')
        else:
            parts.append(f"#strong[{_escaped(strong)}]" if strong else f"#emph[{_inner(emphasis)}]")
        end = found.end()
    return "".join([*parts, _escaped(plain[end:])])


def _answer(question: Any) -> str:
    """The right answer in words: a number with its unit, or the right choices."""
    if question.kind == "number":
        return f"{question.expected:.3g} {question.unit}".strip(" -")
    return " / ".join(choice.text.rstrip(".") for choice in question.choices if not choice.says)


def _inner(text: str) -> str:
    return typst_of(text)


def _escaped(text: str) -> str:
    return _SPECIAL.sub(r"\\\1", text)


def _readable(latex: str) -> str:
    r"""A short formula of the notes or the quiz as plain text: `\sqrt n` -> √n."""
    words = {
        **{r"\cdot": "·", r"\propto": "∝", r"\sqrt": "√", r"\phi": "φ", r"\psi": "ψ", r"\tau": "τ"},
        **{r"\theta": "θ", r"\sigma": "σ", r"\alpha": "α", r"\rho": "ρ", r"\ge": "≥", r"\le": "≤"},
        **{r"\lambda": "λ", r"\mu": "μ", r"\chi": "χ", r"\gamma": "γ", r"\sum": "Σ", r"\top": "T"},
        **{r"\pi": "π", r"\times": "×", r"\bmod": "mod", r"\dot": "", r"\hat": "", r"\bar": ""},
        **{r"\operatorname": "", r"\mathrm": "", r"\left": "", r"\right": "", r"\,": " "},
        **{r"\frac12": "½ ", r"\texttt": ""},
    }
    text = re.sub(r"\\frac\{([^{}]*)\}\{([^{}]*)\}", r"(\1)/(\2)", latex)
    for name in sorted(words, key=len, reverse=True):
        text = text.replace(name, words[name])
    text = text.replace("^2", "²").replace("^3", "³")
    return re.sub(r"[{}]", "", text).replace("\\", "").replace("_", "")


def _goals(opening: str) -> list[str]:
    """The list below "You will be able to" of a notebook's first cell."""
    below = opening.split("You will be able to")[1].split("\n\n**")[0]
    items = re.split(r"^- ", below, flags=re.MULTILINE)[1:]
    return [typst_of(item.strip().rstrip(",;.")) for item in items]


def _solution(cells: list[dict[str, Any]], name: str) -> dict[str, str]:
    """Code of an exercise in the solution notebook, and what its docstring begins with."""
    (cell,) = [cell for cell in cells if cell["metadata"].get("exercise") == name]
    text = "".join(cell["source"])
    doc = re.search(r'"""(.*?)(?:\n\n|""")', text, re.DOTALL)
    body = re.sub(r'\n[ \t]*""".*?"""', "", text, count=1, flags=re.DOTALL)
    first = " ".join(doc[1].split()) if doc else ""
    summary = re.split(r"(?<=\.) (?=Use )", first)[0]
    return {"code": textwrap.dedent(body).strip(), "summary": typst_of(summary)}


def _start(notes: str, name: str) -> str:
    """The paragraph that begins with a bold name: **Goals.** ..."""
    found = re.search(
        rf"\*\*{name}\.?:?\*\*:? *(.*?)(?=\*\*[A-Z][a-z]+[.:]*\*\*|\n\n)", notes, re.DOTALL
    )
    return found[1].strip() if found else ""


def _section(notes: str, *words: str) -> str:
    """The text of the section with one of these words in its heading; empty if there is none."""
    for part in re.split(r"^## ", notes, flags=re.MULTILINE)[1:]:
        title, _, text = part.partition("\n")
        if any(word in title.lower() for word in words):
            return text.strip()
    return ""


def _mistakes(notes: str) -> list[list[str]]:
    """Rows of the table of typical mistakes: the mistake, and the check that shows it."""
    lines = [line for line in _section(notes, "mistake").split("\n") if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    return [row for row in rows if len(row) == 2]


def _exercise_of(lab: Any, check: str) -> str:
    """The exercise that a check of the table belongs to, by name or claim; empty if none."""
    quoted = re.sub(r"\s*\.\.\.\W*$", "", check.strip('"'))
    for each in lab.exercises:
        if re.search(rf"\b{each.name}\b", check) or any(
            quoted in claim.claim for claim in each.checks
        ):
            return str(each.name)
    return ""


def _questions(notes: str) -> list[tuple[str, str]]:
    """Oral questions, each with what to listen for."""
    text = _section(notes, "oral question", "to ask aloud")
    items = re.split(r"^\d+\. ", text, flags=re.MULTILINE)[1:]
    found = []
    for item in items:
        words = re.match(r"\*(.+?)\*(?=\s|$)(.*)", item.strip(), re.DOTALL)
        found.append((words[1], words[2].strip()) if words else (item, ""))
    return found


def _figures(folder: Path, cells: list[dict[str, Any]]) -> Iterator[tuple[str, Mapping[str, str]]]:
    """The figures of a lab: words, and the file that the solution drew, if it is in the cache."""
    cache = OUTPUTS / f"{folder.name}.json"
    drawn = json.loads(cache.read_text("utf-8")) if cache.is_file() else {}
    for number, cell in enumerate(cells):
        name = cell["metadata"].get("figure")
        if not name:
            continue
        after = "".join("".join(each["source"]) + "\n\n" for each in cells[number + 1 : number + 3])
        words = re.search(
            r"\*(?:In words|Alternative text)[^:]*:\*? *(.*?)\*?(?:\n\n|\Z)", after, re.DOTALL
        )
        entry = {"words": " ".join(words[1].split()).strip("* ") if words else name}
        images = [
            output["data"]["image/png"]
            for output in drawn.get("".join(cell["source"]), ())
            if "image/png" in output.get("data", {})
        ]
        if images:
            FIGURES.mkdir(parents=True, exist_ok=True)
            file = FIGURES / f"{folder.name.split('_')[0]}_{name}.png"
            file.write_bytes(base64.b64decode(images[0]))
            entry["file"] = f"/{file.relative_to(ROOT).as_posix()}"
        yield name, entry
