"""Rubric: what a person grades -> one page with figure and answer side by side, and fields whose points go to a file.

The page needs no server: the browser keeps what is typed, and its button saves points.csv, which
`falconwing report --rubric points.csv` merges into the gradebook. A student's texts are shown as texts, never run.
"""

import base64
import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.course.gradebook import COMMENT, Entry
from falconwing_kit.tools.grading.course.looks import Part
from falconwing_kit.tools.grading.lab import Criterion, Lab
from falconwing_kit.tools.grading.records import spreadsheet_cell
from falconwing_kit.tools.reports.page import write_page

Looked = Mapping[str, Any]  # what `looks.look` gives
FIGURES = "figures"
_FROM = {
    "run": "drawn by running the notebook in the box",
    "stored": "as stored in the notebook; running it again drew none here",
    "run, all": "all figures of the notebook, run in the box: the figure's own cell was not found",
    "stored, all": "all figures stored in the notebook, whose own cell was not found; running it again drew none here",
    "not run": "as stored in the notebook, which was not run",
    "not run, all": "all figures stored in the notebook, which was not run: the figure's own cell was not found",
    "none": "no figure",
}


def write_rubric(
    out: Path, lab: Lab, parts: Sequence[Part], entries: Sequence[Entry], looked: Mapping[str, Looked]
) -> Path:
    """Write the page, and the figures into a folder beside it.

    Args:
        out: the folder.
        lab: the lab.
        parts: what is graded, as `looks.graded_parts` says.
        entries: the students' lines, with the points that are known already.
        looked: what was seen of each student's submission.

    Returns:
        The page's path.
    """
    (out / FIGURES).mkdir(parents=True, exist_ok=True)
    shown = [entry for entry in entries if entry.student in looked]
    wanted = "".join(map(_criterion, lab.rubric, parts))
    body = [_student(out, entry, parts, looked[entry.student]) for entry in shown]
    head = [f"<h1>{html.escape(lab.name)}: what a person grades</h1>", f"<dl>{wanted}</dl>", _BAR]
    names = json.dumps([each.name for each in lab.rubric]).replace("<", "\\u003c")
    key = json.dumps(f"falconwing rubric {lab.name} {out.resolve().name}").replace("<", "\\u003c")
    script = _SCRIPT.replace("NAMES", names).replace("KEY", key)
    page = out / "rubric.html"
    write_page(page, f"{lab.name}: rubric", [_STYLE, *head, *body, f"<script>{script}</script>"])
    return page


def _criterion(each: Criterion, part: Part) -> str:
    question = f"<p class=text>{html.escape(part.question)}</p>" if part.question else ""
    return f"<dt>{html.escape(each.name)}, {each.points:g} points</dt><dd>{html.escape(each.look_for)}{question}</dd>"


def _student(out: Path, entry: Entry, parts: Sequence[Part], seen: Looked) -> str:
    """A student's figures to the left, answers to the right, fields below."""
    name = html.escape(entry.student)
    figures = [_figure(out, entry, part, seen["figures"].get(part.name)) for part in parts if part.is_figure]
    answers = [_answer(part.name, seen["answers"].get(part.name, "")) for part in parts if not part.is_figure]
    problem = f"<p>! {html.escape(seen['problem'])}</p>" if seen["problem"] else ""
    fields = "".join(_field(entry, each) for each in entry.lab.rubric)
    comment = html.escape(entry.person.comment)
    label = f"{name}: comment for the student"
    fields += f'<label class=wide>comment <textarea name={COMMENT} aria-label="{label}">{comment}</textarea></label>'
    cell = html.escape(str(spreadsheet_cell(entry.student)), quote=True)
    return (
        f'<section data-student="{cell}"><h2>{name}</h2>{problem}<div class=pair><div>{"".join(figures)}</div>'
        f"<div>{''.join(answers)}</div></div><div class=fields>{fields}</div></section>"
    )


def _answer(name: str, text: str) -> str:
    return f"<h3>{html.escape(name)}</h3><p class=text>{html.escape(text or 'no answer')}</p>"


def _figure(out: Path, entry: Entry, part: Part, seen: Mapping[str, Any] | None) -> str:
    """The pictures of a figure, as files beside the page."""
    images, source = (seen["images"], seen["from"]) if seen else ([], "none")
    shown = []
    for number, image in enumerate(images):
        file = out / FIGURES / f"{entry.file_name}_{part.name}_{number}.png"
        with atomic_write(file) as handle:
            handle.write(base64.b64decode(image))
        alt = html.escape(f"figure {part.name} of {entry.student}", quote=True)
        shown.append(f'<img loading=lazy src="{FIGURES}/{html.escape(file.name, quote=True)}" alt="{alt}">')
    caption = f"<figcaption>{html.escape(part.name)}: {_FROM[source]}</figcaption>"
    return f"<figure>{''.join(shown)}{caption}</figure>"


def _field(entry: Entry, each: Criterion) -> str:
    known = entry.person.points.get(each.name)
    value = "" if known is None else f"{known:g}"
    name = html.escape(each.name, quote=True)
    label = html.escape(f"{entry.student}: {each.name}, 0 to {each.points:g}", quote=True)
    return (
        f'<label>{name} <input name="{name}" type=number min=0 max={each.points:g} step=any value="{value}" '
        f'aria-label="{label}"> of {each.points:g}</label>'
    )


_STYLE = """<style>body { max-width: 84rem; } dt { font-weight: 600; } dd { margin: 0 0 .8rem 1rem; max-width: 60rem; }
.text { white-space: pre-wrap; overflow-wrap: anywhere; max-width: none; } h2 { font-size: 1.2rem; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 1.5rem; }
figure { margin: 0 0 1rem; } img { max-width: 100%; height: auto; border: 1px solid #ccc; }
.fields { display: flex; flex-wrap: wrap; gap: 1rem; padding: .6rem; border: 1px solid #999; }
.wide { flex: 1 1 20rem; }
input { width: 4.5rem; font: inherit; } textarea { width: 100%; height: 2.6rem; font: inherit; }
input:invalid { outline: 3px solid #c1440e; }
#count { margin: 0 1.5rem; font-weight: 600; }
#bar { position: sticky; top: 0; background: #fff; padding: .6rem 0; border-bottom: 1px solid #999; z-index: 1; }
@media (max-width: 50rem) { .pair { grid-template-columns: 1fr; } }</style>"""
_BAR = """<div id=bar><button id=save>save points.csv</button> <span id=count role=status></span>
<span>Typed points stay in this browser until you save them.</span></div>"""
_SCRIPT = """
const names = NAMES, key = KEY, sections = [...document.querySelectorAll('section[data-student]')];
const fields = s => [...s.querySelectorAll('input, textarea')];
let kept = {};
try { kept = JSON.parse(localStorage.getItem(key)) || {}; } catch (error) { kept = {}; }
for (const s of sections) for (const f of fields(s)) {
  const id = s.dataset.student + '/' + f.name;
  if (id in kept) f.value = kept[id];
  f.addEventListener('input', () => {
    kept[id] = f.value;
    try { localStorage.setItem(key, JSON.stringify(kept)); } catch (error) { }
    count();
  });
}
function count() {
  const done = sections.filter(s => names.every(n => fields(s).find(f => f.name === n).value !== '')).length;
  const wrong = document.querySelectorAll('input:invalid').length;
  document.getElementById('count').textContent = `${done} of ${sections.length} students graded` +
    (wrong ? `, ${wrong} fields out of range` : '');
}
const quote = t => '"' + t.replaceAll('"', '""') + '"';
const safe = t => /^[=+@\\t\\r-]/.test(t) ? "'" + t : t;
document.getElementById('save').addEventListener('click', () => {
  const rows = [['student', ...names, 'comment']];
  for (const s of sections)
    rows.push([s.dataset.student, ...[...names, 'comment'].map(n => safe(fields(s).find(f => f.name === n).value))]);
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([rows.map(r => r.map(quote).join(',')).join('\\n') + '\\n'],
    { type: 'text/csv' }));
  link.download = 'points.csv';
  link.click();
});
count();
"""
