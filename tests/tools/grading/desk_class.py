"""A class of synthetic students on three platforms: two small labs, a roster, exports.

Every student hands in one of KINDS, on one of three platforms, under a name as people have them.
"""

import csv
import json
import shutil

from falconwing_kit.core.files import atomic_write
from tests.tools.grading import toys
from tests.tools.grading.small_lab import write_small_lab
from tests.tools.grading.test_submissions import zipped

FIRST = ("Ada", "José", "Zoë", "Иван", "太郎", "Ngọc Anh", "O'Brien", "Jean-Luc", "Åsa", "Maria da")
LAST = ("Lovelace", "García Pérez", "Müller", "Петров", "山田", "Nguyễn", "Smith-Jones", "Silva")
HEAD = "from given import COHORT"
DONE = "def weight(mass):\n    return COHORT['gravity'] * mass"
UNTOUCHED = "def weight(mass):\n    raise NotImplementedError('write weight')"
NOTEBOOK = toys.notebook_bytes(HEAD, DONE)
OTHER_LAB = toys.notebook_bytes(HEAD, DONE.replace("weight", "force"))
OTHER_COURSE = toys.notebook_bytes(HEAD, DONE, metadata={"falconwing_course": "0123456789abcdef"})
# what is handed in: names below the platform's and contents, and the state that must come of it
KINDS = {
    "a notebook": ({"lab01.ipynb": NOTEBOOK}, "graded"),
    "late": ({"lab01.ipynb": NOTEBOOK}, "late"),
    "nothing": (None, "missing"),
    "a page": ({"onlinetext.html": b"<p>done</p>"}, "unreadable"),
    "a script": ({"lab01.py": DONE.encode()}, "unreadable"),
    "a print": ({"lab01.pdf": b"%PDF-1.7"}, "unreadable"),
    "a text": ({"answer.txt": b"the weight is m g"}, "unreadable"),
    "a document": ({"answer.docx": zipped([("word/document.xml", "x")])}, "unreadable"),
    "an empty file": ({"lab01.ipynb": b""}, "unreadable"),
    "an empty zip": ({"lab01.zip": zipped([])}, "unreadable"),
    "half a file": ({"lab01.ipynb": NOTEBOOK[:-9]}, "unreadable"),
    "a zip": ({"work.zip": zipped([("my work/lab01.ipynb", NOTEBOOK)])}, "graded"),
    "zips in zips": (
        {"a.zip": zipped([("b.zip", zipped([("lab01.ipynb", NOTEBOOK)]))])},
        "unreadable",
    ),
    "renamed": ({"lab01.ipynb.txt": NOTEBOOK}, "graded"),
    "two versions": (
        {"lab01.ipynb": toys.notebook_bytes(HEAD, UNTOUCHED), "lab01-2.ipynb": NOTEBOOK},
        "graded",
    ),
    "another lab": ({"lab02.ipynb": OTHER_LAB}, "wrong lab"),
    "another course": ({"lab01.ipynb": OTHER_COURSE}, "graded"),
}
PLATFORMS = ("moodle", "canvas", "gradescope")
RULES = """late_days = 1
late_percent = 10
drop_lowest = 1

[labs.lab01]
deadline = 2027-10-08T23:59:00Z
canvas = "Lab 1 (17)"
"""


def write_labs(folder):
    """lab01 and lab02, in which `weight` is called `force`."""
    first = write_small_lab(folder)
    second = folder / "lab02_small"
    shutil.copytree(first, second)
    for file in second.glob("*.py"):
        text = file.read_text().replace("weight", "force").replace("lab01", "lab02")
        with atomic_write(file, text=True) as handle:
            handle.write(text)


def write_class(folder, size):
    """Roster, rules and three exports of lab01; the expected state of each student, by id.

    Two students of each platform's first twenty have the same full name, where there are so many.
    """
    course = folder / "course"
    course.mkdir()
    (course / "course.toml").write_text(RULES)
    roster, expected, sheet = [], {}, [["Identifier", "Full name", "Email address", "Status"]]
    exports = {name: [] for name in PLATFORMS}
    listed = {}
    for number in range(size):
        platform = PLATFORMS[number % 3]
        kind = list(KINDS)[number // 3 % len(KINDS)]  # each kind on each platform
        twin = number % 3 == 0 and size > 60 and number in (30, 33)
        first, last = FIRST[number % len(FIRST)], LAST[number // len(FIRST) % len(LAST)]
        name = "Kim Lee" if twin else f"{first} {last}" + ("" if number < 80 else f" {number}")
        who = f"s{number:03}"
        roster.append([who, name, f"{who}@uni.edu", 1000 + number, "A", 0])
        files, state = KINDS[kind]
        expected[who] = state
        late = kind == "late"
        said = "Submitted for grading" + (" - 2 days 3 hours late" if late else "")
        sheet.append([f"Participant {7000 + number}", name, f"{who}@uni.edu", said])
        if files is None:
            continue
        before = {
            "moodle": f"{name}_{7000 + number}_assignsubmission_file_/",
            "canvas": f"{canvas_name(first, last)}_{'LATE_' * late}{1000 + number}_99_",
            "gradescope": f"assignment_5_export/submission_{number}/",
        }[platform]
        exports[platform] += [(before + each, content) for each, content in files.items()]
        if platform == "gradescope":
            day = 10 if late else 8
            listed[f"submission_{number}"] = (
                f"  :submitters:\n  - :name: {json.dumps(name)}\n    :sid: {who}\n"
                f"    :email: {who}@uni.edu\n  :created_at: 2027-10-{day:02} 12:00:00.5 Z\n"
            )
    text = "".join(f"{name}:\n{rest}" for name, rest in listed.items())
    exports["gradescope"].append(("assignment_5_export/submission_metadata.yml", text))
    for name, entries in exports.items():
        (folder / f"{name}.zip").write_bytes(zipped(entries))
    head = ["student", "name", "email", "canvas", "group", "extension_days"]
    _write(course / "roster.csv", [head, *roster])
    _write(folder / "worksheet.csv", sheet)
    return expected


def canvas_name(first, last):
    """Canvas's joined name: "Lovelace, Ada" -> "lovelaceada"."""
    return "".join(letter for letter in (last + first).lower() if letter.isalnum())


def _write(path, rows):
    with path.open("w", newline="", encoding="utf-8") as handle:
        csv.writer(handle).writerows(rows)
